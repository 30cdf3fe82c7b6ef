// What the hub said last, by key; who shows it hears once a frame what changed.

/** Keys without their ids: status, map, grid, robot, camera, device, heatmap, capture, event. */
const tables = new Map();
const listeners = [];
let changed = new Map();
let asked = false;

/** Counts for the page's own health, and for who measures it. */
export const stats = { received: 0, applied: 0, frames: 0, begun: performance.now() };

/** All values of a kind by id; kinds without ids have the id "". */
export function all(kind) {
  if (!tables.has(kind)) tables.set(kind, new Map());
  return tables.get(kind);
}

export const one = (kind, id = "") => all(kind).get(id);

/** listener(changed): changed is a Map of kind to the Set of ids that changed. */
export function onChange(listener) {
  listeners.push(listener);
}

/** Take a value over; null takes the key back. */
export function put(key, value) {
  const [kind, id] = parse(key);
  if (value === null) all(kind).delete(id);
  else all(kind).set(id, value);
  stats.received += 1;
  mark(kind, id);
}

/** Forget everything: the hub tells all of it again. */
export function reset() {
  for (const [kind, table] of tables) {
    for (const id of table.keys()) mark(kind, id);
    table.clear();
  }
}

/** Show a kind anew although nothing of it changed. */
export function mark(kind, id = "") {
  if (!changed.has(kind)) changed.set(kind, new Set());
  changed.get(kind).add(id);
  if (!asked) {
    asked = true;
    requestAnimationFrame(flush);
  }
}

function flush() {
  asked = false;
  const now = changed;
  changed = new Map();
  for (const listener of listeners) listener(now);
  for (const ids of now.values()) stats.applied += ids.size;
  stats.frames += 1;
}

function parse(key) {
  const [head, id = "", tail] = key.split("/");
  if (head === "devices") return [tail === "heatmap" ? "heatmap" : "device", id];
  if (head === "map") return [id === "grid" ? "grid" : "map", ""];
  if (head === "cameras") return ["camera", id];
  if (head === "events") return ["event", id];
  return [head, id];
}
