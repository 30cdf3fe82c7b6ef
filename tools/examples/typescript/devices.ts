// Where everything is, and what happens from now on: zenoh in TypeScript, for Node or a browser.
//
// zenoh-ts speaks to a zenohd with the remote-api plugin, which speaks to the hub (remote-api.json5 beside this):
//     zenohd --config remote-api.json5
//     npm install && npx tsc && node devices.js
//
// The types below are what the hub's own schemas say: get vad/*/schema/vad.device.v1.

import { Config, ReplyError, Session } from "@eclipse-zenoh/zenoh-ts";

interface Device {
  schema: "vad.device.v1";
  mac: string;
  name: string | null;
  state: "discovered" | "waiting" | "capturing" | "mapped" | "stale" | "failed";
  reason: string;
  x_m: number | null;
  y_m: number | null;
  radius90_m: number | null;
  room: string | null;
}

interface Devices {
  schema: "vad.devices.v1";
  devices: Device[];
}

interface Event {
  schema: "vad.event.v1";
  kind: "joined" | "mapped" | "moved" | "lost";
  mac: string;
  text: string;
}

const session = await Session.open(new Config("ws/127.0.0.1:10000"));

const replies = await session.get("vad/*/devices?state=mapped|waiting;max_sigma_m=0.5");
for await (const reply of replies!) {
  const result = reply.result();
  if (result instanceof ReplyError) {
    // {"schema": "vad.error.v1", "code": "bad_selector", "text": "..."}
    throw new Error(result.payload().toString());
  }
  const { devices } = JSON.parse(result.payload().toString()) as Devices;
  for (const d of devices) {
    const where = d.x_m === null || d.y_m === null ? d.reason : `${d.x_m.toFixed(2)}, ${d.y_m.toFixed(2)}`;
    console.log(`${d.name ?? d.mac}: ${d.state}, ${d.room ?? "no room"}, ${where}`);
  }
}

const events = await session.declareSubscriber("vad/*/events");
for await (const sample of events.receiver()!) {
  const event = JSON.parse(sample.payload().toString()) as Event;
  console.log(`${event.kind}: ${event.text}`);
}
