// How the hub is: what it does now, and each of its parts, those in trouble first.

import { byId, el, setAttribute, setText } from "./dom.js";
import { all, one, onChange, stats } from "./store.js";
import { ago, CAMERAS, counted, duration, metres, PARTS, printable, ROBOTS, sentence } from "./words.js";

const URGENCY = { failed: 0, degraded: 1, starting: 2, ok: 3 };
const rows = new Map();
const nodes = {};

export function begin() {
  nodes.heading = el("p", { class: "summary" });
  nodes.eyes = el("dl", { class: "facts" });
  nodes.parts = el("ul", { class: "plain parts" });
  nodes.foot = el("p", { class: "hint" });
  byId("pane-health").append(nodes.heading, nodes.eyes, nodes.parts, nodes.foot);
  onChange((news) => {
    if (news.has("status")) drawStatus();
    if (news.has("camera") || news.has("robot")) drawEyes();
    if (["status", "map", "device"].some((kind) => news.has(kind))) drawSource();
  });
}

function drawStatus() {
  const status = one("status");
  if (!status) return;
  setText(byId("step"), sentence(status.step));
  const broken = status.parts.filter((part) => part.state === "degraded" || part.state === "failed");
  setAttribute(byId("health-mark"), "hidden", broken.length ? null : "");
  setText(byId("health-mark"), String(broken.length));
  setText(nodes.heading, broken.length
    ? `${broken.length} of ${counted(status.parts.length, "part")} need${broken.length === 1 ? "s" : ""} attention`
    : `All ${status.parts.length} parts work`);
  const sorted = [...status.parts].sort((a, b) => URGENCY[a.state] - URGENCY[b.state]);
  for (const [name, row] of rows) {
    if (!status.parts.some((part) => part.part === name)) {
      row.node.remove();
      rows.delete(name);
    }
  }
  sorted.forEach((part, i) => {
    if (!rows.has(part.part)) rows.set(part.part, new PartRow(part.part));
    const row = rows.get(part.part);
    row.update(part);
    if (nodes.parts.children[i] !== row.node) nodes.parts.insertBefore(row.node, nodes.parts.children[i] ?? null);
  });
  setText(nodes.foot, `vad ${printable(status.version)}, up ${duration(status.uptime_s)}. This page took ${counted(stats.received, "change")}.`);
}

class PartRow {
  constructor(name) {
    this.dot = el("span", { "aria-hidden": "true" });
    this.state = el("span", { class: "kind" });
    this.detail = el("span", { class: "note" });
    this.last = el("span", { class: "note last" });
    this.counts = el("p", { class: "counts" });
    this.more = el("details", {}, el("summary", { text: "Counts" }), this.counts);
    this.node = el("li", {}, this.dot, el("div", { class: "row-main" },
      el("span", { class: "row-name" }, printable(name), " ", this.state), this.detail, this.last, this.more));
  }

  update(part) {
    setAttribute(this.dot, "class", `dot part-${part.state}`);
    setText(this.state, PARTS[part.state] ?? part.state);
    setText(this.detail, printable(part.detail));
    const told = part.last_error && part.last_error !== part.detail
      ? `Last trouble${part.last_error_at ? ` ${ago(part.last_error_at)}` : ""}: ${printable(part.last_error)}` : "";
    setText(this.last, told);
    const counts = Object.entries(part.counters).sort();
    this.more.hidden = counts.length === 0;
    if (!this.more.open) return;
    setText(this.counts, counts.map(([name, count]) => {
      const rate = part.rates_per_s[name];
      return `${printable(name)} ${count.toLocaleString("en")}${rate ? ` (${rate}/s)` : ""}`;
    }).join(", "));
  }
}

function drawEyes() {
  const told = [];
  for (const [id, camera] of all("camera")) {
    let words = CAMERAS[camera.state] ?? camera.state;
    if (camera.state === "collecting" || camera.state === "recalibrating") words += `, ${Math.round(camera.percent)} %`;
    if (camera.deviation_m !== null && camera.state === "valid") words += `, floor points ±${metres(camera.deviation_m)}`;
    told.push([`Camera ${printable(id)}`, camera.reason ? `${words}. ${sentence(camera.reason)}` : words]);
  }
  const robot = one("robot");
  if (robot) told.push(["Robot", ROBOTS[robot.status] ?? robot.status]);
  nodes.eyes.replaceChildren(...told.flatMap(([term, words]) => [el("dt", { text: term }), el("dd", { text: sentence(words) })]));
}

/** Whatever is not real says so. */
function drawSource() {
  const sources = new Set();
  for (const kind of ["status", "map", "device"]) for (const value of all(kind).values()) sources.add(value.source);
  sources.delete("live");
  const badge = byId("source");
  badge.hidden = sources.size === 0;
  setText(badge, [...sources].sort().join(" + "));
}
