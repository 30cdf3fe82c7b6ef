// Puts the page together: tabs, what is selected, whether the hub is there.

import * as account from "./account.js";
import * as detail from "./detail.js";
import * as devices from "./devices.js";
import { byId, setText } from "./dom.js";
import * as happenings from "./happenings.js";
import * as health from "./health.js";
import * as plan from "./plan.js";
import { follow } from "./stream.js";
import { sentence } from "./words.js";

const TABS = ["devices", "events", "health"];
let selected = null;
let brokenAt = null;

function choose(mac) {
  const before = selected;
  selected = mac;
  plan.select(mac);
  byId("list-view").hidden = mac !== null;
  if (mac !== null) openTab("devices");
  detail.show(mac);
  if (mac === null && before !== null) devices.focusRow(before);
}

function openTab(name, focus = false) {
  for (const tab of TABS) {
    const button = byId(`tab-${tab}`);
    button.setAttribute("aria-selected", String(tab === name));
    button.tabIndex = tab === name ? 0 : -1;
    byId(`pane-${tab}`).hidden = tab !== name;
    if (focus && tab === name) button.focus();
  }
}

function tabKeys(event) {
  const at = TABS.findIndex((tab) => byId(`tab-${tab}`) === event.target);
  const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: TABS.length - 1 }[event.key];
  if (at < 0 || to === undefined) return;
  openTab(TABS[(to + TABS.length) % TABS.length], true);
  event.preventDefault();
}

function connection(state, reason) {
  const banner = byId("offline");
  if (state === "open") {
    if (brokenAt !== null) account.refresh();
    brokenAt = null;
    banner.hidden = true;
    document.body.classList.remove("stale");
    return;
  }
  brokenAt ??= new Date();
  const since = brokenAt.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
  banner.hidden = false;
  setText(banner, reason ? sentence(reason)
    : `The hub does not answer. What you see is from ${since}; the page goes on by itself when the hub is back.`);
  document.body.classList.add("stale");
}

plan.begin(choose);
devices.begin(choose, plan.highlight);
detail.begin(() => choose(null));
happenings.begin(choose);
health.begin();
account.begin();
for (const tab of TABS) byId(`tab-${tab}`).addEventListener("click", () => {
  if (tab === "devices" && selected !== null) choose(null);
  openTab(tab);
});
document.querySelector(".tabs").addEventListener("keydown", tabKeys);
follow(connection);
