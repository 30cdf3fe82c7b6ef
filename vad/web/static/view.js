// What part of the plan is seen: metres to pixels, zoom and pan by wheel, fingers and keys.

const MIN_PX_PER_M = 4;
const MAX_PX_PER_M = 600;
const FIT_PAD_PX = { side: 26, top: 26, bottom: 60 }; // the buttons stand at the bottom
const STEP = 1.35;
const CLICK_PX = 5;

/** The view of an SVG whose units are pixels. changed(): redraw what depends on it. */
export class View {
  constructor(svg, changed) {
    this.svg = svg;
    this.changed = changed;
    this.bounds = null; // x0, y0, x1, y1 in metres
    this.scale = 50; // pixels per metre
    this.x = 0; // metres in the middle
    this.y = 0;
    this.width = 0;
    this.height = 0;
    this.fitted = true;
    this.dragged = false;
    this.fingers = new Map();
    new ResizeObserver(() => this.resized()).observe(svg);
    svg.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    svg.addEventListener("pointerdown", (event) => this.down(event));
    svg.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"]) svg.addEventListener(end, (event) => this.up(event));
    svg.addEventListener("keydown", (event) => this.key(event));
  }

  px(x, y) {
    return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  }

  /** The world group's transform: metres, y up. */
  get matrix() {
    const [left, top] = this.px(0, 0);
    return `matrix(${this.scale} 0 0 ${-this.scale} ${left} ${top})`;
  }

  show(bounds) {
    if (this.bounds && this.bounds.every((value, i) => value === bounds[i])) return;
    this.bounds = bounds;
    this.fit();
  }

  fit() {
    this.fitted = true;
    if (!this.bounds || !this.width) return;
    const [x0, y0, x1, y1] = this.bounds;
    const across = Math.max(x1 - x0, 0.5);
    const up = Math.max(y1 - y0, 0.5);
    const { side, top, bottom } = FIT_PAD_PX;
    const free = [this.width - 2 * side, this.height - top - bottom].map((size) => Math.max(size, 40));
    this.scale = limited(Math.min(free[0] / across, free[1] / up));
    this.x = (x0 + x1) / 2;
    this.y = (y0 + y1) / 2 - (bottom - top) / 2 / this.scale;
    this.drawn();
  }

  resized() {
    const box = this.svg.getBoundingClientRect();
    if (box.width === this.width && box.height === this.height) return;
    this.width = box.width;
    this.height = box.height;
    if (this.fitted) this.fit();
    else this.drawn();
  }

  /** Zoom by a factor; the place at pixels (px, py) stays where it is. */
  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const before = this.scale;
    this.scale = limited(this.scale * factor);
    this.x += (px - this.width / 2) * (1 / before - 1 / this.scale);
    this.y -= (py - this.height / 2) * (1 / before - 1 / this.scale);
    this.fitted = false;
    this.drawn();
  }

  pan(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
    this.fitted = false;
    this.drawn();
  }

  drawn() {
    if (this.bounds) {
      // the plan stays within reach
      const [x0, y0, x1, y1] = this.bounds;
      this.x = Math.min(Math.max(this.x, x0), x1);
      this.y = Math.min(Math.max(this.y, y0), y1);
    }
    // a finger scrolls the page while everything is seen, and moves the plan once it is zoomed
    this.svg.classList.toggle("zoomed", !this.fitted);
    this.changed();
  }

  wheel(event) {
    const scrolls = document.documentElement.scrollHeight > window.innerHeight + 1;
    if (scrolls && !event.ctrlKey) return;
    event.preventDefault();
    this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), ...this.at(event));
  }

  at(event) {
    const box = this.svg.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  down(event) {
    if (event.button) return;
    this.fingers.set(event.pointerId, this.at(event));
    if (this.fingers.size === 1) {
      this.dragged = false;
      this.begun = this.at(event);
    }
  }

  move(event) {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    const now = this.at(event);
    if (!this.dragged) {
      if (Math.hypot(now[0] - this.begun[0], now[1] - this.begun[1]) < CLICK_PX) return;
      this.dragged = true;
    }
    if (!this.svg.hasPointerCapture(event.pointerId)) this.svg.setPointerCapture(event.pointerId);
    if (this.fingers.size === 2) {
      const [other] = [...this.fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
      const apart = (a) => Math.max(Math.hypot(a[0] - other[0], a[1] - other[1]), 1);
      this.zoom(apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      this.pan((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
    } else if (this.fingers.size === 1) {
      this.pan(now[0] - before[0], now[1] - before[1]);
    }
    this.fingers.set(event.pointerId, now);
  }

  up(event) {
    this.fingers.delete(event.pointerId);
  }

  key(event) {
    const far = 60;
    const moves = { ArrowLeft: [far, 0], ArrowRight: [-far, 0], ArrowUp: [0, far], ArrowDown: [0, -far] };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (moves[event.key]) this.pan(...moves[event.key]);
    else if (event.key === "+" || event.key === "=") this.zoom(STEP);
    else if (event.key === "-") this.zoom(1 / STEP);
    else if (event.key === "0") this.fit();
    else return;
    event.preventDefault();
  }

  in() {
    this.zoom(STEP);
  }

  out() {
    this.zoom(1 / STEP);
  }
}

const limited = (scale) => Math.min(Math.max(scale, MIN_PX_PER_M), MAX_PX_PER_M);
