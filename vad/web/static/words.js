// How values are said to people.

/** States of a device: in a word, in a sentence for one that tells no reason, and its place in the list. */
export const STATES = {
  capturing: { word: "Being measured", group: 0, sentence: "It is being measured right now." },
  waiting: { word: "Waiting", group: 1, sentence: "It waits to be measured." },
  discovered: { word: "New", group: 1, sentence: "It has joined the network and was not measured yet." },
  failed: { word: "Unsure", group: 1, sentence: "It could not be placed well enough." },
  stale: { word: "Out of date", group: 1, sentence: "What was measured no longer holds." },
  mapped: { word: "Mapped", group: 2, sentence: "" },
};
export const GROUPS = ["Being measured", "Not sure yet", "Mapped"];

export const CAPTURES = {
  idle: "gets ready",
  armed: "waits for the walk to begin",
  recording: "listens while somebody walks",
  stopping: "finishes listening",
  solving: "works out where it is",
  done: "done",
  aborted: "broken off",
};

export const CAMERAS = {
  uncalibrated: "does not know where it is yet",
  collecting: "learns where it is from the robot's drive",
  valid: "knows where it is",
  invalid: "no longer knows where it is",
  recalibrating: "learns anew where it is",
};

export const ROBOTS = {
  unknown: "nothing heard yet",
  localised: "knows where it is",
  docked: "in its dock",
  not_localised: "does not know where it is",
  lifted: "lifted up",
  lost: "lost: it had a place, and is not heard or was put elsewhere",
};

export const PARTS = { ok: "works", starting: "starts", degraded: "in trouble", failed: "failed" };

// controls, and marks that turn the direction of writing: a name must not play with what stands beside it
const UNPRINTABLE = /[\u0000-\u001f\u007f-\u009f\u200e\u200f\u202a-\u202e\u2066-\u2069]/gu;

export const printable = (text) => text.replace(UNPRINTABLE, "\ufffd");

export const nameOf = (device) => printable(device.name || device.host_name || device.mac);

/** As a sentence: capital letter, full stop. */
export function sentence(text) {
  const plain = printable(text).trim();
  if (!plain) return "";
  return plain[0].toUpperCase() + plain.slice(1) + (/[.!?]$/u.test(plain) ? "" : ".");
}

export const metres = (value) => `${value < 0.095 ? value.toFixed(2) : value.toFixed(1)} m`;
export const plusMinus = (value) => `±${metres(value)}`;

export const counted = (count, what, many = `${what}s`) => `${count.toLocaleString("en")} ${count === 1 ? what : many}`;

/** Where a device is, in one line. */
export function whereWords(device) {
  const where = [];
  if (device.room) where.push(printable(device.room));
  if (device.radius90_m !== null && device.x_m !== null) where.push(plusMinus(device.radius90_m));
  return where.join(" · ");
}

/** Why a device is not settled, or where it is. */
export function whyWords(device) {
  const state = STATES[device.state];
  if (device.reason) return sentence(device.reason);
  return state ? state.sentence : "";
}

/** `3 min ago`; the whole time where it is long ago. */
export function ago(text, now = Date.now()) {
  const at = Date.parse(text);
  if (Number.isNaN(at)) return "";
  const seconds = Math.round((now - at) / 1000);
  if (seconds < 10) return "just now";
  if (seconds < 60) return `${seconds} s ago`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ago`;
  if (seconds < 86_400) return `${Math.floor(seconds / 3600)} h ago`;
  if (seconds < 7 * 86_400) return counted(Math.floor(seconds / 86_400), "day") + " ago";
  return new Date(at).toLocaleDateString(undefined, { day: "numeric", month: "short", year: "numeric" });
}

export const exactly = (text) => new Date(text).toLocaleString();

export function duration(seconds) {
  const whole = Math.floor(seconds);
  for (const [size, unit, below, belowUnit] of [
    [86_400, "d", 3600, "h"],
    [3600, "h", 60, "min"],
    [60, "min", 1, "s"],
  ]) {
    if (whole >= size) return `${Math.floor(whole / size)} ${unit} ${Math.floor((whole % size) / below)} ${belowUnit}`;
  }
  return `${whole} s`;
}
