#!/usr/bin/env python3
"""The same with nothing but zenoh and JSON, as in any language that zenoh has a library for.

pip install eclipse-zenoh; python plain_zenoh.py [ENDPOINT]
"""

import json
import sys

import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5(
    "connect/endpoints", json.dumps([sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"])
)
config.insert_json5("scouting/multicast/enabled", "false")

with zenoh.open(config) as session:
    # One reply holds all devices. Where each is to reply for itself (vad/*/devices/*), ask without
    # consolidation: zenoh's default can block `get` for ever with more than 256 replies.
    for reply in session.get("vad/*/devices?state=mapped|waiting;bbox=0,0,20,20"):
        if reply.err is not None:  # {"schema": "vad.error.v1", "code": "bad_selector", "text": "..."}
            sys.exit(reply.err.payload.to_string())
        for device in json.loads(reply.ok.payload.to_string())["devices"]:
            print(device["mac"], device["state"], device["room"], device["x_m"], device["y_m"])

    for reply in session.get("vad/*/schema/vad.device.v1"):
        print(json.loads(reply.ok.payload.to_string())["$defs"]["DeviceMessage"]["title"])

    print("from now on:", flush=True)
    with session.declare_subscriber("vad/*/events") as events:
        for sample in events:
            print(json.loads(sample.payload.to_string())["text"], flush=True)
