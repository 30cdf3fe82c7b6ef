// Names beside points: where a name would cover another one or a point, it is left out.

const HEIGHT_PX = 15;
const GAP_PX = 10;
const POINT_PX = 8;
const measure = document.createElement("canvas").getContext("2d");
const widths = new Map();

function widthOf(text) {
  if (!widths.has(text)) {
    if (widths.size > 2000) widths.clear();
    measure.font = "600 12px system-ui, sans-serif";
    widths.set(text, measure.measureText(text).width);
  }
  return widths.get(text);
}

/**
 * Place labels in turn, the first come first served.
 * wanted: {x, y, text, must} in pixels; taken: boxes [left, top, right, bottom] to keep free. Returns for each
 * the {x, y, anchor} of its text's middle, or null where there is no room.
 */
export function place(wanted, taken, width, height) {
  const boxes = [...wanted.map(({ x, y }) => around(x, y)), ...taken];
  const points = wanted.length;
  const found = new Array(points).fill(null);
  wanted.forEach(({ x, y, text, must }, i) => {
    const w = widthOf(text);
    const choices = [
      [x + GAP_PX, y, "start", x + GAP_PX, x + GAP_PX + w],
      [x - GAP_PX, y, "end", x - GAP_PX - w, x - GAP_PX],
      [x, y - 16, "middle", x - w / 2, x + w / 2],
      [x, y + 17, "middle", x - w / 2, x + w / 2],
    ];
    let best = null;
    for (const [tx, ty, anchor, left, right] of choices) {
      const box = [left - 2, ty - HEIGHT_PX / 2, right + 2, ty + HEIGHT_PX / 2];
      const inside = box[0] >= 0 && box[2] <= width && box[1] >= 0 && box[3] <= height;
      const free = boxes.every((other, j) => j === i || !overlap(box, other));
      if (inside && free) {
        best = { x: tx, y: ty, anchor, box };
        break;
      }
      if (must && !best && inside) best = { x: tx, y: ty, anchor, box };
    }
    if (best) {
      boxes.push(best.box);
      found[i] = best;
    }
  });
  return found;
}

/** The box that a point's mark needs. */
export const around = (x, y) => [x - POINT_PX, y - POINT_PX, x + POINT_PX, y + POINT_PX];

const overlap = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
