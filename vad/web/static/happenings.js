// What happens: measurements under way over the map, and what happened as a list.

import { bdi, byId, el, setText } from "./dom.js";
import { all, one, onChange } from "./store.js";
import { ago, CAPTURES, counted, duration, exactly, metres, nameOf, printable, sentence } from "./words.js";

const SHOWN = 50;
const KINDS = { joined: "Joined", mapped: "Mapped", moved: "Moved", lost: "Lost" };
const seen = new Set(); // events that were there when the page was opened are not read out
let settled = false;

/** chosen(mac): somebody wants to see a device. */
export function begin(chosen) {
  byId("measuring").addEventListener("click", (event) => {
    const mac = event.target.closest("[data-mac]")?.dataset.mac;
    if (mac) chosen(mac);
  });
  setTimeout(() => {
    settled = true;
  }, 3000);
  onChange((news) => {
    if (news.has("capture") || news.has("device")) drawMeasuring();
    if (news.has("event") || news.has("capture")) drawList();
    if (news.has("event")) readOut();
  });
  setInterval(drawList, 30_000);
}

const under = (capture) => !["idle", "done", "aborted"].includes(capture.state);

function drawMeasuring() {
  const now = [...all("capture").values()].filter(under);
  const box = byId("measuring");
  box.hidden = now.length === 0;
  while (box.children.length > now.length) box.lastChild.remove();
  now.forEach((capture, i) => {
    if (!box.children[i]) {
      box.append(el("button", { type: "button", class: "capture" }, el("span", { class: "pulse", "aria-hidden": "true" }),
        el("span", { class: "row-main" }, el("span", { class: "row-name" }, bdi("")), el("span", { class: "note" })),
        el("progress", { max: "1", "aria-label": "Progress" })));
    }
    const button = box.children[i];
    button.dataset.mac = capture.mac;
    const device = one("device", capture.mac);
    setText(button.querySelector("bdi"), device ? nameOf(device) : capture.mac);
    setText(button.querySelector(".note"), sentence(`${CAPTURES[capture.state]}, ${duration(capture.walk_s)} of walking, ${counted(capture.packets, "packet")}`));
    button.querySelector("progress").value = capture.progress;
  });
}

function drawList() {
  const events = [...all("event").entries()].sort((a, b) => Number(b[0]) - Number(a[0]));
  for (const [id] of events.slice(SHOWN)) all("event").delete(id);
  const captures = [...all("capture").values()].filter((capture) => !under(capture) && capture.state !== "idle");
  const lines = [
    ...events.slice(0, SHOWN).map(([, event]) => ({ at: event.published_at, kind: KINDS[event.kind] ?? event.kind, text: event.text })),
    ...captures.map((capture) => ({ at: capture.published_at, kind: "Measured", text: outcome(capture) })),
  ].sort((a, b) => (a.at < b.at ? 1 : -1)).slice(0, SHOWN);
  const pane = byId("pane-events");
  if (lines.length === 0) {
    pane.replaceChildren(el("p", { class: "hint", text: "Nothing has happened since the hub was started." }));
    return;
  }
  pane.replaceChildren(el("ol", { class: "plain events" }, ...lines.map((line) => el("li", {},
    el("span", { class: "kind", text: line.kind }), bdi(sentence(line.text)),
    el("time", { datetime: line.at, title: exactly(line.at), text: ago(line.at) })))));
}

function outcome(capture) {
  const device = one("device", capture.mac);
  const name = device ? nameOf(device) : capture.mac;
  if (capture.state === "aborted") return `${name}: broken off${capture.reason ? `: ${printable(capture.reason)}` : ""}`;
  const walk = `${duration(capture.walk_s)} of walking, ${counted(capture.packets, "packet")}`;
  if (!capture.result) return `${name}: ${walk}${capture.reason ? `, ${printable(capture.reason)}` : ""}`;
  return `${name}: ${walk}; this walk alone says ±${metres(capture.result.radius90_m)}`;
}

/** The newest event for who does not see the list. */
function readOut() {
  let latest = null;
  for (const [id, event] of all("event")) {
    if (!seen.has(id)) latest = event;
    seen.add(id);
  }
  if (latest && settled) setText(byId("said"), sentence(latest.text));
}
