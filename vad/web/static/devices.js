// The list of devices: three groups, each row says where the device is or why it waits.

import { bdi, byId, el, setAttribute, setText } from "./dom.js";
import { all, onChange } from "./store.js";
import { counted, GROUPS, nameOf, STATES, whereWords, whyWords } from "./words.js";

const SEARCH_FROM = 9; // fewer devices are found by looking

const rows = new Map(); // MAC -> Row
const groups = [];
let choose = () => {};
let point = () => {};
let wanted = "";

/** chosen(mac): a device is to be shown; pointed(mac, on): the pointer is over its row. */
export function begin(chosen, pointed) {
  choose = chosen;
  point = pointed;
  for (const title of GROUPS) {
    const list = el("ul", { class: "plain devices" });
    const heading = el("h3", { text: title });
    const section = el("section", { hidden: true }, heading, list);
    groups.push({ list, section, order: [] });
    byId("list").append(section);
  }
  byId("list").append(el("p", { id: "none", class: "hint", text: "No device has joined the network yet." }));
  byId("search").addEventListener("input", (event) => {
    wanted = event.target.value.trim().toLowerCase();
    for (const row of rows.values()) row.filter();
    headings();
  });
  byId("list").addEventListener("keydown", arrows);
  onChange(changed);
}

export const focusRow = (mac) => rows.get(mac)?.button.focus();

class Row {
  constructor(mac) {
    this.mac = mac;
    this.name = bdi("");
    this.note = el("span", { class: "note" });
    this.mark = el("span", { class: "dot", "aria-hidden": "true" });
    this.state = el("span", { class: "unseen" });
    const main = el("span", { class: "row-main row-name" }, el("span", {}, this.name, this.state));
    this.place = el("span", { class: "row-place" });
    this.button = el("button", {
      type: "button", class: "row", "data-mac": mac, click: () => choose(mac),
      pointerenter: () => point(mac, true), pointerleave: () => point(mac, false),
      focus: () => point(mac, true), blur: () => point(mac, false),
    }, this.mark, main, this.place, this.note);
    this.node = el("li", {}, this.button);
    this.group = -1;
    this.sort = "";
    this.words = "";
  }

  /** Whether it belongs elsewhere in the list now. */
  update(device) {
    const state = STATES[device.state] ?? { word: device.state, group: 1 };
    const name = nameOf(device);
    setText(this.name, name);
    setText(this.state, `, ${state.word}`);
    setAttribute(this.mark, "class", `dot ${device.state}`);
    setText(this.place, whereWords(device));
    setText(this.note, state.group === 2 ? (device.moved ? whyWords(device) : "") : whyWords(device));
    setAttribute(this.button, "class", device.in_network ? "row" : "row away");
    this.words = [name, device.mac, device.room, device.host_name, device.vendor, device.ip, ...(device.macs ?? [])]
      .join("\n").toLowerCase();
    this.filter();
    const sort = `${name.toLowerCase()}\n${this.mac}`;
    const moved = this.group !== state.group || this.sort !== sort;
    this.group = state.group;
    this.sort = sort;
    return moved;
  }

  filter() {
    this.node.hidden = wanted !== "" && !this.words.includes(wanted);
  }
}

function changed(news) {
  const macs = news.get("device");
  if (!macs) return;
  let reorder = false;
  for (const mac of macs) {
    const device = all("device").get(mac);
    if (!device) {
      rows.get(mac)?.node.remove();
      reorder = rows.delete(mac) || reorder;
      continue;
    }
    if (!rows.has(mac)) rows.set(mac, new Row(mac));
    reorder = rows.get(mac).update(device) || reorder;
  }
  if (reorder) arrange();
  headings();
}

function arrange() {
  const held = document.activeElement;
  groups.forEach((group, i) => {
    const members = [...rows.values()].filter((row) => row.group === i).sort((a, b) => (a.sort < b.sort ? -1 : 1));
    members.forEach((row, at) => {
      if (group.list.children[at] !== row.node) group.list.insertBefore(row.node, group.list.children[at] ?? null);
    });
  });
  // a row that is moved loses the focus
  if (held !== document.activeElement && byId("list").contains(held)) held.focus();
}

function headings() {
  const counts = groups.map((_, i) => [...rows.values()].filter((row) => row.group === i).length);
  groups.forEach((group) => {
    group.section.hidden = ![...group.list.children].some((row) => !row.hidden);
  });
  byId("none").hidden = rows.size > 0;
  byId("search-row").hidden = rows.size < SEARCH_FROM && !wanted;
  setText(byId("count"), rows.size ? String(rows.size) : "");
  const told = [`${counts[2]} of ${counted(rows.size, "device")} mapped`];
  if (counts[0]) told.push(`${counts[0]} being measured`);
  setText(byId("summary"), rows.size ? told.join(" · ") : "");
}

function arrows(event) {
  const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  const shown = [...byId("list").querySelectorAll("li:not([hidden]) > .row")];
  const at = shown.indexOf(document.activeElement);
  let next = step ? at + step : { Home: 0, End: shown.length - 1 }[event.key];
  if (at < 0 || next === undefined) return;
  next = Math.min(Math.max(next, 0), shown.length - 1);
  shown[next].focus();
  event.preventDefault();
}
