// Who looks: may they change something? And the wishes of those who may.

import { bdi, byId, el, setText } from "./dom.js";
import { onChange } from "./store.js";
import { ago, counted, printable } from "./words.js";

export const account = { mayChange: false, canLogIn: false };
const listeners = [];
let known = ""; // the devices that were there when the ignored ones were asked for

export const onAccount = (listener) => listeners.push(listener);

export function begin() {
  byId("account").addEventListener("click", () => (account.mayChange ? logOut() : openLogin()));
  byId("login-cancel").addEventListener("click", () => byId("login").close());
  byId("login-form").addEventListener("submit", logIn);
  onChange((news) => {
    if (news.has("device")) askIgnored(news.get("device"));
  });
  refresh();
}

/** Ask the hub what this browser may do. */
export async function refresh() {
  const answer = await ask("api/session");
  if (!answer.ok) return;
  account.mayChange = answer.body.may_change;
  account.canLogIn = answer.body.login;
  setText(byId("hub"), printable(answer.body.hub));
  document.title = `${printable(answer.body.hub)} · Wi-Fi devices`;
  const button = byId("account");
  button.hidden = !account.canLogIn;
  setText(button, account.mayChange ? "Log out" : "Log in");
  for (const listener of listeners) listener();
  known = "";
  await showIgnored();
}

/** Have a wish granted; why it is not, empty where it is. */
export async function wish(what) {
  const answer = await ask("api/wish", what);
  if (answer.ok) {
    setText(byId("said"), answer.body.text);
    await showIgnored();
    return "";
  }
  if (answer.status === 401) await refresh();
  return answer.text;
}

async function logIn(event) {
  event.preventDefault();
  const field = byId("token");
  const answer = await ask("api/login", { token: field.value });
  const error = byId("login-error");
  error.hidden = answer.ok;
  setText(error, answer.ok ? "" : answer.text);
  if (!answer.ok) {
    field.select();
    return;
  }
  field.value = "";
  byId("login").close();
  await refresh();
}

async function logOut() {
  await ask("api/logout", {});
  await refresh();
}

function openLogin() {
  byId("login-error").hidden = true;
  byId("login").showModal();
}

/** The ignored ones change when a device goes or comes back. */
function askIgnored(macs) {
  const now = [...macs].join();
  if (now === known) return;
  clearTimeout(askIgnored.timer);
  askIgnored.timer = setTimeout(showIgnored, 1500);
}

async function showIgnored() {
  const answer = await ask("api/ignored");
  if (!answer.ok) return;
  const { ignored } = answer.body;
  byId("ignored").hidden = ignored.length === 0;
  setText(byId("ignored-count"), String(ignored.length));
  const list = byId("ignored-list");
  const fresh = ignored.map((device) => {
    const seen = device.last_seen ? `, last seen ${ago(device.last_seen)}` : "";
    const note = device.by_settings ? "by the settings" : `${device.mac}${seen}`;
    const back = account.mayChange && !device.by_settings
      ? el("button", { type: "button", class: "quiet", click: () => wish({ mac: device.mac, ignore: false }) }, "Take back")
      : null;
    return el("li", {}, el("span", { class: "row-main" }, el("span", { class: "row-name" }, bdi(printable(device.name || device.mac))),
      el("span", { class: "note", text: note })), back);
  });
  // what is the same stays: a button that is being pressed must not go from under the finger
  const words = (nodes) => [...nodes].map((node) => node.textContent).join("\n");
  if (words(list.children) !== words(fresh)) list.replaceChildren(...fresh);
  byId("ignored").title = counted(ignored.length, "ignored device");
}

async function ask(address, body) {
  const request = body === undefined ? {} : {
    method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body),
  };
  try {
    const answer = await fetch(address, request);
    if (answer.status === 204) return { ok: true };
    const content = await answer.json();
    return answer.ok ? { ok: true, body: content } : { ok: false, status: answer.status, text: content.text };
  } catch {
    return { ok: false, status: 0, text: "The hub does not answer." };
  }
}
