// The floor plan: what lies in metres is in the group `world`, what keeps its size in the group `overlay`.

import { byId, setAttribute, setText, svg } from "./dom.js";
import { around, place } from "./labels.js";
import { all, mark, one, onChange } from "./store.js";
import { View } from "./view.js";
import { counted, nameOf, plusMinus, printable, STATES } from "./words.js";

const CHI2_90 = 4.605; // the 90 % quantile of chi-squared with two degrees of freedom
const CIRCLE_POINTS = 48;
const ROBOT_RADIUS_M = 0.17;
const dark = matchMedia("(prefers-color-scheme: dark)");

let view;
let selected = null;
let choose = () => {};
let labelsAsked = false;
const drawn = new Map(); // MAC -> its nodes
const layers = {};
const cameras = new Map();

/** chosen(mac): somebody clicked on a device, or on nothing (null). */
export function begin(chosen) {
  choose = chosen;
  const plan = byId("plan");
  for (const name of ["grid", "rooms", "covered", "heat", "regions"]) layers[name] = svg("g", { class: name });
  byId("world").append(...Object.values(layers));
  for (const name of ["roomNames", "cameras", "robot", "devices", "names"]) layers[name] = svg("g", { class: name });
  layers.robot.append(svg("circle", { class: "body" }), svg("path", { class: "nose" }));
  layers.robot.append(svg("title", { text: "The robot" }));
  layers.robot.setAttribute("visibility", "hidden");
  byId("overlay").append(layers.roomNames, layers.cameras, layers.robot, layers.devices, layers.names);
  view = new View(plan, redraw);
  plan.addEventListener("click", (event) => {
    if (!view.dragged) choose(event.target.closest("[data-mac]")?.dataset.mac ?? null);
  });
  plan.addEventListener("keydown", (event) => event.key === "Escape" && choose(null));
  byId("zoom-in").addEventListener("click", () => view.in());
  byId("zoom-out").addEventListener("click", () => view.out());
  byId("zoom-fit").addEventListener("click", () => view.fit());
  dark.addEventListener("change", () => mark("grid"));
  onChange(changed);
}

/** Show one device's heatmap, the others faintly; null shows all. */
export function select(mac) {
  const before = selected;
  selected = mac;
  byId("plan").classList.toggle("choosing", mac !== null);
  for (const one of [before, mac]) if (one && drawn.has(one)) drawDevice(one);
  drawHeat();
  askLabels();
}

export function highlight(mac, on) {
  drawn.get(mac)?.marker.classList.toggle("hover", on);
  drawn.get(mac)?.region.classList.toggle("hover", on);
}

function changed(news) {
  if (news.has("map")) drawMap();
  if (news.has("map") || news.has("grid")) drawGrid();
  if (news.has("map") || news.has("camera")) drawCameras();
  if (news.has("map")) for (const mac of all("device").keys()) drawDevice(mac);
  for (const mac of news.get("device") ?? []) drawDevice(mac);
  if (news.has("device") || news.has("map")) {
    describe();
    askLabels();
  }
  if (news.has("robot")) drawRobot();
  if (news.get("heatmap")?.has(selected) || news.has("map")) drawHeat();
}

function redraw() {
  byId("world").setAttribute("transform", view.matrix);
  for (const mac of drawn.keys()) putMarker(mac);
  drawRoomNames();
  for (const [id, node] of cameras) putCamera(id, node);
  drawRobot();
  drawScale();
  askLabels();
}

function drawMap() {
  const map = one("map");
  byId("no-map").hidden = map !== undefined;
  layers.rooms.replaceChildren();
  layers.roomNames.replaceChildren();
  if (!map) return;
  map.rooms.forEach((room, i) => {
    if (room.polygon_m.length < 3) return;
    layers.rooms.append(svg("polygon", { points: points(room.polygon_m), class: `tint${i % 6}` }));
    layers.roomNames.append(svg("text", { class: "room", text: printable(room.name) }));
  });
  const [x0, y0, x1, y1] = map.bounds_m;
  byId("plan").parentElement.style.setProperty("--shape", (y1 - y0) / Math.max(x1 - x0, 0.1));
  view.show(map.bounds_m);
  drawRoomNames();
}

function drawRoomNames() {
  const rooms = (one("map")?.rooms ?? []).filter((room) => room.polygon_m.length >= 3);
  rooms.forEach((room, i) => {
    // in the upper left, where names of devices seldom are
    const left = Math.min(...room.polygon_m.map(([x]) => x));
    const top = Math.max(...room.polygon_m.map(([, y]) => y));
    const [x, y] = view.px(left, top);
    const text = layers.roomNames.children[i];
    setAttribute(text, "x", Math.round(x + 12));
    setAttribute(text, "y", Math.round(y + 22));
  });
}

function drawGrid() {
  const map = one("map");
  const grid = one("grid");
  layers.grid.replaceChildren();
  if (!map) return;
  const [x, y, yaw] = map.origin;
  const [width, height] = [map.width * map.resolution_m, map.height * map.resolution_m];
  const group = svg("g", { transform: `translate(${x} ${y}) rotate(${(yaw * 180) / Math.PI})` });
  layers.grid.append(group);
  if (!grid) {
    group.append(svg("rect", { width, height, class: "floor" }));
    return;
  }
  const theme = dark.matches ? "dark" : "light";
  const picture = svg("image", { ...upright(0, 0, width, height), href: `api/plan/${theme}.png?v=${grid.version}` });
  picture.addEventListener("load", () => performance.mark("vad: plan shown"), { once: true });
  group.append(picture);
}

// pictures have their first row on top, and the world's y points up
const upright = (x, y, width, height) => ({
  x, y: -y - height, width, height, transform: "scale(1 -1)", preserveAspectRatio: "none",
});

function drawHeat() {
  const heat = selected && one("heatmap", selected);
  const shown = Boolean(heat) && heat.epoch === one("map")?.epoch;
  byId("legend").hidden = !shown;
  byId("plan").classList.toggle("heated", shown);
  if (!shown) {
    layers.heat.replaceChildren();
    return;
  }
  const [x0, y0, x1, y1] = heat.bounds_m;
  const href = `api/heatmap/${encodeURIComponent(selected)}.png?v=${heat.version}`;
  const old = layers.heat.firstChild;
  if (old && old.getAttribute("href") === href) return;
  layers.heat.replaceChildren(svg("image", { ...upright(x0, y0, x1 - x0, y1 - y0), href }));
}

function drawCameras() {
  const map = one("map");
  layers.covered.replaceChildren();
  layers.cameras.replaceChildren();
  cameras.clear();
  byId("legend-view").hidden = true;
  for (const [id, camera] of all("camera")) {
    if (!camera.position_m || camera.epoch !== map?.epoch) continue;
    if (camera.floor_m) {
      layers.covered.append(svg("polygon", { points: points(camera.floor_m) }));
      byId("legend-view").hidden = false;
    }
    const node = svg("g", { class: "camera" }, svg("path", { d: "M4 -3 L11 -7 V7 L4 3 Z" }),
      svg("rect", { x: -8, y: -6, width: 13, height: 12, rx: 3 }), svg("title", { text: `Camera ${printable(id)}` }));
    layers.cameras.append(node);
    cameras.set(id, node);
    putCamera(id, node);
  }
}

function putCamera(id, node) {
  const camera = one("camera", id);
  if (!camera?.position_m) return;
  const [x, y] = view.px(camera.position_m[0], camera.position_m[1]);
  // the optical axis is the camera's z, the third column of map_from_camera
  const axis = camera.map_from_camera ? camera.map_from_camera.map((row) => row[2]) : [1, 0];
  const turn = (-Math.atan2(axis[1], axis[0]) * 180) / Math.PI;
  node.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${turn.toFixed(1)})`);
}

function drawRobot() {
  const robot = one("robot");
  const here = robot && robot.x_m !== null && robot.x_m !== undefined && robot.epoch === one("map")?.epoch;
  setAttribute(layers.robot, "visibility", here ? null : "hidden");
  if (!here) return;
  const [x, y] = view.px(robot.x_m, robot.y_m);
  const r = Math.max(ROBOT_RADIUS_M * view.scale, 7);
  const turn = (-robot.yaw_rad * 180) / Math.PI;
  layers.robot.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${turn.toFixed(1)})`);
  setAttribute(layers.robot.children[0], "r", r.toFixed(1));
  setAttribute(layers.robot.children[1], "d", `M${(0.25 * r).toFixed(1)} ${(-0.5 * r).toFixed(1)} L${(0.8 * r).toFixed(1)} 0 L${(0.25 * r).toFixed(1)} ${(0.5 * r).toFixed(1)}`);
}

/** Devices of another map epoch are not drawn: their coordinates mean something else there. */
const placed = (device) => device && device.x_m !== null && device.x_m !== undefined
  && device.epoch === one("map")?.epoch;

function drawDevice(mac) {
  const device = one("device", mac);
  if (!placed(device)) {
    const gone = drawn.get(mac);
    if (gone) {
      gone.region.remove();
      gone.marker.remove();
      gone.label.remove();
      drawn.delete(mac);
    }
    return;
  }
  let nodes = drawn.get(mac);
  if (!nodes) {
    nodes = {
      region: svg("polygon", { "data-mac": mac }),
      marker: svg("g", { "data-mac": mac }, svg("circle", { r: 16, class: "hit" }), svg("circle", { r: 11, class: "halo" }),
        svg("circle", { r: 6.5, class: "dot" }), svg("title")),
      label: svg("text", { "data-mac": mac }),
    };
    layers.regions.append(nodes.region);
    layers.devices.append(nodes.marker);
    layers.names.append(nodes.label);
    drawn.set(mac, nodes);
  }
  const chosen = mac === selected ? " chosen" : "";
  setAttribute(nodes.region, "class", `region ${device.state}${chosen}`);
  setAttribute(nodes.marker, "class", `device ${device.state}${chosen}`);
  setAttribute(nodes.label, "class", `name ${device.state}${chosen}`);
  setAttribute(nodes.region, "points", outline(device));
  setText(nodes.marker.lastChild, `${nameOf(device)}: ${STATES[device.state]?.word ?? device.state}`);
  if (chosen && layers.devices.lastChild !== nodes.marker) layers.devices.append(nodes.marker);
  putMarker(mac);
}

function putMarker(mac) {
  const device = one("device", mac);
  const [x, y] = view.px(device.x_m, device.y_m);
  setAttribute(drawn.get(mac).marker, "transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
}

/** The 90 % region: as given, else the Gaussian's ellipse, else the circle. */
function outline(device) {
  if (device.region90?.length >= 3) return points(device.region90);
  let [a, b, c] = [device.radius90_m ?? 0, 0, device.radius90_m ?? 0];
  if (device.covariance_m2) {
    const [[xx, xy], [, yy]] = device.covariance_m2;
    // the Cholesky factor takes a circle to the ellipse
    a = Math.sqrt(Math.max(xx, 1e-9));
    b = xy / a;
    c = Math.sqrt(Math.max(yy - b * b, 0));
    [a, b, c] = [a, b, c].map((value) => value * Math.sqrt(CHI2_90));
  }
  const around = Array.from({ length: CIRCLE_POINTS }, (_, i) => (2 * Math.PI * i) / CIRCLE_POINTS);
  return points(around.map((turn) => [
    device.x_m + a * Math.cos(turn), device.y_m + b * Math.cos(turn) + c * Math.sin(turn),
  ]));
}

const points = (polygon) => polygon.map(([x, y]) => `${x.toFixed(3)},${y.toFixed(3)}`).join(" ");

/** Labels are laid out a few times a second at most: nobody reads faster. */
function askLabels() {
  if (labelsAsked) return;
  labelsAsked = true;
  setTimeout(() => {
    labelsAsked = false;
    drawLabels();
  }, 120);
}

function drawLabels() {
  const wanted = [...drawn].map(([mac, nodes]) => {
    const device = one("device", mac);
    const [x, y] = view.px(device.x_m, device.y_m);
    const text = mac === selected && device.radius90_m !== null ? `${nameOf(device)} ${plusMinus(device.radius90_m)}` : nameOf(device);
    return { x, y, text, must: mac === selected, nodes };
  });
  wanted.sort((a, b) => Number(b.must) - Number(a.must) || (a.text < b.text ? -1 : 1));
  const taken = [...cameras.keys()].map((id) => around(...view.px(...one("camera", id).position_m.slice(0, 2))));
  for (const text of layers.roomNames.children) {
    const box = text.getBBox();
    taken.push([box.x, box.y, box.x + box.width, box.y + box.height]);
  }
  const found = place(wanted, taken, view.width, view.height);
  wanted.forEach(({ nodes, text }, i) => {
    const at = found[i];
    setAttribute(nodes.label, "visibility", at ? null : "hidden");
    if (!at) return;
    setText(nodes.label, text);
    setAttribute(nodes.label, "x", at.x.toFixed(1));
    setAttribute(nodes.label, "y", (at.y + 4).toFixed(1));
    setAttribute(nodes.label, "text-anchor", at.anchor);
  });
}

function drawScale() {
  const bar = byId("scale");
  const length = [10, 5, 2, 1, 0.5, 0.2, 0.1].find((size) => size * view.scale <= 140) ?? 0.1;
  bar.style.width = `${Math.round(length * view.scale)}px`;
  setText(byId("scale-text"), `${length} m`);
}

/** The map in words, for who does not see it. */
function describe() {
  const map = one("map");
  const rooms = new Map();
  for (const device of all("device").values()) {
    if (placed(device) && device.room) rooms.set(device.room, (rooms.get(device.room) ?? 0) + 1);
  }
  const told = [...rooms].map(([room, count]) => `${printable(room)}: ${counted(count, "device")}`).join(", ");
  setText(byId("map-words"), map ? `${counted(drawn.size, "device")} on the floor plan. ${told}` : "");
}
