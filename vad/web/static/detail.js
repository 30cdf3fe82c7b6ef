// One device: where it is, why it waits, who it is, and what may be done with it.

import { account, onAccount, wish } from "./account.js";
import { bdi, byId, el, setText } from "./dom.js";
import { all, one, onChange } from "./store.js";
import { ago, CAPTURES, counted, duration, exactly, metres, nameOf, printable, sentence, STATES, whyWords } from "./words.js";

let shown = null;
let close = () => {};
const parts = {};

/** closed(): the list is to be shown again. */
export function begin(closed) {
  close = closed;
  parts.back = el("button", { type: "button", class: "back quiet", click: () => close() }, "‹ All devices");
  parts.name = bdi("");
  parts.title = el("h3", { class: "detail-name", tabindex: "-1" }, parts.name);
  parts.state = el("span", { class: "chip" });
  parts.words = el("p", { class: "detail-words" });
  parts.capture = el("div", { class: "detail-capture", hidden: true });
  parts.facts = el("dl", { class: "facts" });
  parts.error = el("p", { class: "error", role: "alert", hidden: true });
  parts.rename = el("button", { type: "button", click: () => openRename() }, "Rename");
  parts.ignore = el("button", { type: "button", click: () => ignore() }, "Ignore");
  parts.forget = el("button", { type: "button", class: "danger-text", click: () => forget() }, "Forget");
  parts.buttons = el("div", { class: "buttons left" }, parts.rename, parts.ignore, parts.forget);
  parts.field = el("input", { id: "new-name", type: "text", maxlength: "64", autocomplete: "off", spellcheck: "false" });
  parts.form = el("form", { class: "rename", hidden: true, submit: (event) => rename(event), keydown: (event) => {
    if (event.key === "Escape") closeRename();
  } },
    el("label", { for: "new-name", text: "Name" }), parts.field,
    el("p", { class: "hint", text: "Empty: what it calls itself." }),
    el("div", { class: "buttons left" }, el("button", { type: "submit", class: "strong" }, "Save"),
      el("button", { type: "button", class: "quiet", click: () => closeRename() }, "Cancel")));
  parts.reader = el("p", { class: "hint" });
  byId("detail").append(parts.back, el("div", { class: "detail-head" }, parts.title, parts.state), parts.words, parts.capture,
    parts.facts, parts.form, parts.buttons, parts.error, parts.reader);
  byId("detail").addEventListener("keydown", (event) => {
    if (event.key === "Escape" && parts.form.hidden) close();
  });
  onChange((news) => {
    if (shown === null) return;
    if (news.get("device")?.has(shown) || news.has("capture") || news.has("map")) draw();
  });
  onAccount(draw);
}

/** Show a device; null shows none. */
export function show(mac) {
  shown = mac;
  byId("detail").hidden = mac === null;
  if (mac === null) return;
  closeRename();
  problem("");
  draw();
  parts.title.focus({ preventScroll: true });
}

function draw() {
  const device = shown && one("device", shown);
  if (shown === null) return;
  if (!device) {
    close(); // forgotten or ignored
    return;
  }
  const state = STATES[device.state] ?? { word: device.state };
  setText(parts.name, nameOf(device));
  parts.state.className = `chip ${device.state}`;
  setText(parts.state, state.word);
  setText(parts.words, words(device));
  drawCapture();
  facts(device);
  const { mayChange, canLogIn } = account;
  parts.buttons.hidden = !mayChange || !parts.form.hidden;
  parts.reader.hidden = mayChange;
  setText(parts.reader, canLogIn ? "Log in to rename, ignore or forget it."
    : "This page only shows. Who runs the hub can allow changes with web.token_file.");
}

/** The state in a sentence or two. */
function words(device) {
  const told = [];
  if (device.x_m !== null && device.x_m !== undefined && device.radius90_m !== null) {
    const where = device.room ? `In ${printable(device.room)}` : "On the map";
    const doubt = device.state === "mapped" ? "" : ", as far as is known";
    told.push(`${where}${doubt}. In 9 of 10 cases the true place is within ${metres(device.radius90_m)} of the mark.`);
  }
  told.push(whyWords(device));
  if (device.x_m !== null && device.x_m !== undefined && device.epoch !== one("map")?.epoch) {
    told.push("Its place is of an older floor plan and is not drawn.");
  }
  return told.filter(Boolean).join(" ");
}

function facts(device) {
  const rows = [];
  const add = (term, value, title) => value && rows.push([term, value, title]);
  if (device.x_m !== null && device.x_m !== undefined) {
    add("Place", `x ${device.x_m.toFixed(2)} m, y ${device.y_m.toFixed(2)} m`);
    if (device.height90_m) add("Height", `${device.height90_m.map(metres).join(" to ")} above the floor`);
  }
  if (device.walks) {
    const { walk_s: seconds, packets } = device.evidence ?? {};
    const heard = packets ? `, ${counted(packets, "packet")}` : "";
    add("Measured", `${counted(device.walks, "walk")}${seconds ? `, ${duration(seconds)}` : ""}${heard}`);
  }
  if (device.updated_at) add("Last change", ago(device.updated_at), exactly(device.updated_at));
  add("In the network", device.in_network ? "yes" : `no${device.last_seen ? `, last ${ago(device.last_seen)}` : ""}`);
  if (device.first_seen) add("First seen", ago(device.first_seen), exactly(device.first_seen));
  if (device.host_name) add("Calls itself", printable(device.host_name));
  if (device.vendor) add("Maker", printable(device.vendor));
  if (device.ip) add("IP address", device.ip);
  const macs = device.macs?.length ? device.macs : [device.mac];
  add(macs.length > 1 ? "Addresses" : "Address", macs.join(", ") + (device.random_mac ? " (made up by the device)" : ""));
  if (device.agent) add("Wi-Fi node", printable(device.agent));
  const dl = parts.facts;
  while (dl.children.length > 2 * rows.length) dl.lastChild.remove();
  rows.forEach(([term, value, title], i) => {
    if (!dl.children[2 * i]) dl.append(el("dt"), el("dd"));
    setText(dl.children[2 * i], term);
    setText(dl.children[2 * i + 1], value);
    dl.children[2 * i + 1].title = title ?? "";
  });
}

function drawCapture() {
  const now = [...all("capture").values()].find((c) => c.mac === shown && !["done", "aborted", "idle"].includes(c.state));
  parts.capture.hidden = !now;
  if (!now) return;
  if (!parts.capture.firstChild) parts.capture.append(el("p"), el("progress", { max: "1", "aria-label": "Measuring" }));
  const [text, bar] = parts.capture.children;
  setText(text, sentence(`${CAPTURES[now.state]}: ${duration(now.walk_s)} of walking, ${counted(now.packets, "packet")}`));
  bar.value = now.progress;
}

function openRename() {
  parts.form.hidden = false;
  parts.field.value = one("device", shown)?.name ?? "";
  parts.field.focus();
  parts.field.select();
  draw();
}

function closeRename() {
  const had = byId("detail").contains(document.activeElement);
  parts.form.hidden = true;
  if (shown) draw();
  if (had && !parts.buttons.hidden) parts.rename.focus();
}

async function rename(event) {
  event.preventDefault();
  if (await done({ mac: shown, name: parts.field.value })) closeRename();
}

async function ignore() {
  const device = one("device", shown);
  const yes = await sure(`Ignore ${nameOf(device)}?`, "It leaves the list and the map and is not measured any more. What is known of it is kept; it can be taken back from the list of ignored devices.", "Ignore");
  if (yes) await done({ mac: device.mac, ignore: true });
}

async function forget() {
  const device = one("device", shown);
  const walks = device.walks ? ` and its ${counted(device.walks, "walk")}` : "";
  const yes = await sure(`Forget ${nameOf(device)}?`, `Its place, its name${walks} are dropped for good. When it joins again it is new.`, "Forget");
  if (yes) await done({ mac: device.mac, forget: true });
}

async function done(what) {
  const refused = await wish(what);
  problem(refused);
  return !refused;
}

function problem(text) {
  parts.error.hidden = !text;
  setText(parts.error, text);
}

function sure(title, text, yes) {
  const dialog = byId("sure");
  setText(byId("sure-title"), title);
  setText(byId("sure-text"), text);
  setText(byId("sure-yes"), yes);
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
  });
}
