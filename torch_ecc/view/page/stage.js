// The picture with what is marked in it: zoom, pan, and the tools that mark. Points are frame px, pixel centres at
// integers, as everywhere in torch_ecc.

import { colour } from "./words.js";

const SMALLEST = 5; // px: side of the smallest patch
const NEAR = 9; // screen px: as good as on it

export class Stage extends EventTarget {
  marks = [];
  starts = null; // of each mark: the [x, y] that its displacement is of
  poses = null; // of each mark: [dx, dy, theta] in the frame that is shown, null where it was not found
  doubted = [];
  selected = -1;
  editable = true;
  tool = "box";
  overlay = null; // { image, x: [first, last], y: [first, last] } to be laid over the frame
  #image = null;
  #width = 640;
  #height = 480;
  #view = { scale: 1, x: 0, y: 0 }; // a point p is at (p + 0.5) scale + (x, y), in CSS px of the canvas
  #whole = true; // the view is the whole frame
  #action = null; // what a pointer that is down does
  #fingers = new Map(); // where those are that touch, by the pointer's number
  #points = []; // of the outline that is being clicked
  #hover = null;
  #line = null; // the last known length

  constructor(canvas) {
    super();
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    new ResizeObserver(() => this.#fitCanvas()).observe(canvas.parentElement);
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    canvas.addEventListener("pointerup", (event) => this.#up(event));
    canvas.addEventListener("pointercancel", (event) => (this.#fingers.delete(event.pointerId), this.cancel()));
    canvas.addEventListener("dblclick", () => this.#closeOutline());
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.#key(event));
  }

  setFrame(width, height) {
    if (width === this.#width && height === this.#height) return;
    [this.#width, this.#height] = [width, height];
    this.#fitCanvas();
  }

  setImage(image) {
    this.#image?.close?.();
    this.#image = image;
    this.draw();
  }

  setTool(tool) {
    this.tool = tool;
    this.cancel();
    this.canvas.style.cursor = tool === "pan" ? "grab" : "crosshair";
  }

  cancel() {
    this.#action = null;
    this.#points = [];
    this.#line = null;
    this.#tell("draft", null);
    this.draw();
  }

  // The longer side of the whole picture as it is seen, px of the screen: more would not be.
  side() {
    return Math.ceil(this.#view.scale * devicePixelRatio * Math.max(this.#width, this.#height));
  }

  // The middle of what is seen, whole px.
  middle() {
    const p = this.#toFrame(this.canvas.clientWidth / 2, this.canvas.clientHeight / 2);
    return [Math.round(p[0]), Math.round(p[1])];
  }

  fit() {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const scale = Math.min(w / this.#width, h / this.#height);
    this.#view = { scale, x: (w - scale * this.#width) / 2, y: (h - scale * this.#height) / 2 };
    this.#whole = true;
    this.draw();
  }

  zoom(factor, x = this.canvas.clientWidth / 2, y = this.canvas.clientHeight / 2) {
    const view = this.#view;
    const scale = bounded(view.scale * factor);
    const by = scale / view.scale;
    this.#view = { scale, x: x - (x - view.x) * by, y: y - (y - view.y) * by };
    this.#whole = false;
    this.draw();
  }

  #fitCanvas() {
    const width = this.canvas.parentElement.clientWidth;
    const height = Math.max(180, Math.min((width * this.#height) / this.#width, innerHeight * 0.66));
    this.canvas.style.height = `${height}px`;
    this.canvas.width = Math.round(width * devicePixelRatio);
    this.canvas.height = Math.round(height * devicePixelRatio);
    if (this.#whole) this.fit();
    this.#paint(); // a canvas of another size is empty until then
  }

  #toFrame(x, y) {
    const view = this.#view;
    return [(x - view.x) / view.scale - 0.5, (y - view.y) / view.scale - 0.5];
  }

  #toScreen([x, y]) {
    const view = this.#view;
    return [(x + 0.5) * view.scale + view.x, (y + 0.5) * view.scale + view.y];
  }

  #inside([x, y]) {
    return [Math.min(Math.max(x, 0), this.#width - 1), Math.min(Math.max(y, 0), this.#height - 1)];
  }

  #pointer(event) {
    return this.#toFrame(event.offsetX, event.offsetY);
  }

  // ---- pointer and keys

  #down(event) {
    this.canvas.focus({ preventScroll: true });
    if (event.pointerType === "touch" && this.#touch(event)) return;
    const p = this.#pointer(event);
    const pan = this.tool === "pan" || event.button === 1;
    if (!pan && (event.button !== 0 || (!this.editable && this.tool !== "scale"))) return;
    this.canvas.setPointerCapture(event.pointerId);
    if (pan) this.#action = { kind: "pan", x: event.offsetX, y: event.offsetY, view: { ...this.#view } };
    else if (this.tool === "outline") this.#corner(p, event);
    else if (this.tool === "scale") this.#action = { kind: "scale", from: p, to: p };
    else {
      const hit = this.#hit(p);
      if (hit >= 0 && hit === this.selected) this.#action = { kind: "move", from: p, mark: this.marks[hit], hit };
      else this.#action = { kind: "box", from: this.#inside(p).map(Math.round), hit };
    }
  }

  // Two fingers: what the first one began is no mark, they zoom and pan.
  #touch(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.#fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (this.#fingers.size !== 2) return this.#fingers.size > 2;
    const points = this.tool === "outline" ? this.#points.slice(0, -1) : [];
    this.cancel();
    this.#points = points;
    this.#action = { kind: "pinch", fingers: [...this.#fingers.values()], view: { ...this.#view } };
    return true;
  }

  #pinch({ fingers, view }) {
    const [before, now] = [fingers, [...this.#fingers.values()]].map(([a, b]) => ({
      middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2],
      apart: Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1),
    }));
    const scale = bounded((view.scale * now.apart) / before.apart);
    const by = scale / view.scale;
    const [x, y] = [view.x, view.y].map((start, k) => now.middle[k] - (before.middle[k] - start) * by);
    this.#view = { scale, x, y };
    this.#whole = false;
  }

  #move(event) {
    if (this.#fingers.has(event.pointerId)) this.#fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    const p = this.#pointer(event);
    this.#hover = p;
    const action = this.#action;
    if (action?.kind === "pan") {
      this.#view.x = action.view.x + event.offsetX - action.x;
      this.#view.y = action.view.y + event.offsetY - action.y;
      this.#whole = false;
    } else if (action?.kind === "pinch") {
      if (this.#fingers.size === 2) this.#pinch(action);
    } else if (action?.kind === "scale") {
      action.to = p;
      this.#tell("draft", { length: this.#lengthOf(action) });
    } else if (action?.kind === "move") {
      action.moved = shifted(action.mark, Math.round(p[0] - action.from[0]), Math.round(p[1] - action.from[1]));
      this.#tell("draft", { mark: action.moved });
    } else if (action?.kind === "box") {
      action.box = this.#boxTo(action.from, p, event.shiftKey);
      this.#tell("draft", action.box && { mark: action.box });
    } else if (!this.#points.length) return;
    this.draw();
  }

  #up(event) {
    this.#fingers.delete(event.pointerId);
    const action = this.#action;
    if (!action) return; // a corner of an outline: it is done with the press
    this.#action = null;
    if (action.kind === "scale") {
      if (this.#lengthOf(action) > 2) {
        this.#line = action;
        this.#tell("length", this.#lengthOf(action));
      }
    } else if (action.kind === "move" && action.moved) this.#change(this.marks.with(action.hit, action.moved));
    else if (action.kind === "box") {
      if (action.box) this.#add(action.box);
      else this.select(action.hit);
    }
    this.#tell("draft", null);
    this.draw();
  }

  #boxTo([x0, y0], p, square) {
    let [x1, y1] = this.#inside(p).map(Math.round);
    if (square) {
      const side = Math.min(Math.abs(x1 - x0), Math.abs(y1 - y0));
      x1 = x0 + Math.sign(x1 - x0) * side;
      y1 = y0 + Math.sign(y1 - y0) * side;
    }
    const [w, h] = [Math.abs(x1 - x0) + 1, Math.abs(y1 - y0) + 1];
    return w < SMALLEST || h < SMALLEST ? null : { x: (x0 + x1) / 2, y: (y0 + y1) / 2, w, h };
  }

  #lengthOf({ from, to }) {
    return Math.hypot(to[0] - from[0], to[1] - from[1]);
  }

  #corner(p, event) {
    const [first] = this.#points;
    if (first && this.#points.length > 2) {
      const [a, b] = [this.#toScreen(first), [event.offsetX, event.offsetY]];
      if (Math.hypot(a[0] - b[0], a[1] - b[1]) < NEAR) return this.#closeOutline();
    }
    const corner = this.#inside(p).map((value) => Math.round(value * 2) / 2);
    if (`${corner}` === `${this.#points.at(-1)}`) return; // the second click of two, which closes
    this.#points.push(corner);
    if (this.#points.length > 2) this.#tell("draft", { mark: { points: [...this.#points] } });
    this.draw();
  }

  #closeOutline() {
    const points = this.#points;
    if (this.tool !== "outline" || points.length < 3) return;
    this.#points = [];
    this.#tell("draft", null);
    this.#add({ points });
  }

  #wheel(event) {
    event.preventDefault();
    this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.offsetX, event.offsetY);
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? 10 : 1;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    const mark = this.marks[this.selected];
    if (event.key === "Escape") this.cancel();
    else if (event.key === "Enter") this.#closeOutline();
    else if (event.key === "Backspace" && this.#points.length) {
      this.#points.pop();
      this.draw();
    } else if ((event.key === "Delete" || event.key === "Backspace") && mark && this.editable) this.remove(this.selected);
    else if (moves[event.key] && mark && this.editable) this.#change(this.marks.with(this.selected, shifted(mark, ...moves[event.key])));
    else return;
    event.preventDefault();
  }

  // ---- marks

  select(number) {
    this.selected = number;
    this.#tell("select", number);
    this.draw();
  }

  remove(number) {
    this.selected = -1;
    this.#change(this.marks.filter((_, index) => index !== number));
  }

  #add(mark) {
    this.selected = this.marks.length;
    this.#change([...this.marks, mark]);
  }

  #change(marks) {
    this.marks = marks;
    this.#tell("change", marks);
    this.draw();
  }

  // The smallest mark that a point is in, -1 if there is none.
  #hit(p) {
    let [best, size] = [-1, Infinity];
    this.marks.forEach((mark, number) => {
      const corners = outline(mark);
      const area = Math.abs(corners.reduce((sum, [x, y], k) => sum + x * corners.at(k - 1)[1] - y * corners.at(k - 1)[0], 0));
      if (area < size && contains(corners, p)) [best, size] = [number, area];
    });
    return best;
  }

  // ---- drawing

  draw() {
    this.#pending ??= requestAnimationFrame(() => {
      this.#pending = null;
      this.#paint();
    });
  }
  #pending = null;

  #paint() {
    const { context, canvas } = this;
    const view = this.#view;
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    context.imageSmoothingEnabled = view.scale < 3;
    if (this.#image) context.drawImage(this.#image, view.x, view.y, this.#width * view.scale, this.#height * view.scale);
    this.#paintOverlay();
    const action = this.#action;
    this.marks.forEach((mark, number) => {
      const shown = action?.kind === "move" && action.hit === number && action.moved ? action.moved : mark;
      this.#paintMark(shown, number);
    });
    if (action?.box) this.#paintLine(outline(action.box), "#fff", true);
    if (this.#points.length) this.#paintLine(this.#hover ? [...this.#points, this.#hover] : this.#points, "#fff", false);
    const line = action?.kind === "scale" ? action : this.#line;
    if (line) this.#paintLine([line.from, line.to], "#ffd84d", false);
  }

  #paintOverlay() {
    if (!this.overlay) return;
    const { image, x, y } = this.overlay;
    const cell = [(x[1] - x[0]) / Math.max(image.width - 1, 1), (y[1] - y[0]) / Math.max(image.height - 1, 1)];
    const first = this.#toScreen([x[0] - cell[0] / 2, y[0] - cell[1] / 2]);
    const last = this.#toScreen([x[1] + cell[0] / 2, y[1] + cell[1] / 2]);
    this.context.globalAlpha = 0.55;
    this.context.imageSmoothingEnabled = true;
    this.context.drawImage(image, first[0], first[1], last[0] - first[0], last[1] - first[1]);
    this.context.globalAlpha = 1;
  }

  #paintMark(mark, number) {
    const pose = this.poses ? this.poses[number] : [0, 0, 0];
    const lost = !pose;
    const corners = lost ? outline(mark) : turned(outline(mark), this.starts?.[number] ?? centre(mark), pose);
    this.#paintLine(corners, lost ? "#ff6b60" : colour(number), true, {
      width: number === this.selected ? 3 : 1.6,
      dash: lost || this.doubted[number] ? [5, 4] : [],
    });
    const [x, y] = this.#toScreen(corners.reduce((a, b) => (b[1] + b[0] < a[1] + a[0] ? b : a)));
    if (this.marks.length > 60 && number !== this.selected) return;
    this.#label(lost ? `${number} lost` : `${number}`, x, y, lost ? "#ff6b60" : colour(number));
  }

  #paintLine(points, stroke, closed, { width = 1.6, dash = [] } = {}) {
    const { context } = this;
    const path = new Path2D();
    points.forEach((p, k) => path[k ? "lineTo" : "moveTo"](...this.#toScreen(p)));
    if (closed) path.closePath();
    context.setLineDash([]);
    context.strokeStyle = "rgb(0 0 0 / .55)";
    context.lineWidth = width + 2;
    context.stroke(path);
    context.setLineDash(dash);
    context.strokeStyle = stroke;
    context.lineWidth = width;
    context.stroke(path);
    context.setLineDash([]);
  }

  #label(text, x, y, fill) {
    const { context } = this;
    context.font = "600 12px system-ui, sans-serif";
    const width = context.measureText(text).width + 8;
    const [left, top] = [Math.min(Math.max(x, 0), this.canvas.clientWidth - width), Math.max(y - 17, 0)];
    context.fillStyle = "rgb(13 17 23 / .8)";
    context.fillRect(left, top, width, 16);
    context.fillStyle = fill;
    context.fillText(text, left + 4, top + 12);
  }

  #tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}

// A zoom within reason: screen px for one of the frame's.
function bounded(scale) {
  return Math.min(Math.max(scale, 0.02), 64);
}

// The corners of what a mark covers: of a box around its outermost pixels.
export function outline(mark) {
  if (mark.points) return mark.points;
  const [w, h] = [mark.w / 2, mark.h / 2];
  return [[mark.x - w, mark.y - h], [mark.x + w, mark.y - h], [mark.x + w, mark.y + h], [mark.x - w, mark.y + h]];
}

export function centre(mark) {
  if (!mark.points) return [mark.x, mark.y];
  const [xs, ys] = [mark.points.map((p) => p[0]), mark.points.map((p) => p[1])];
  return [(Math.min(...xs) + Math.max(...xs)) / 2, (Math.min(...ys) + Math.max(...ys)) / 2];
}

function shifted(mark, dx, dy) {
  if (mark.points) return { points: mark.points.map(([x, y]) => [x + dx, y + dy]) };
  return { ...mark, x: mark.x + dx, y: mark.y + dy };
}

// Points about a centre after a displacement, with the sign of torch_ecc's theta: counter-clockwise on the screen.
function turned(points, [cx, cy], [dx, dy, theta]) {
  const [c, s] = [Math.cos(theta), Math.sin(theta)];
  return points.map(([x, y]) => [cx + dx + c * (x - cx) + s * (y - cy), cy + dy - s * (x - cx) + c * (y - cy)]);
}

function contains(corners, [x, y]) {
  let inside = false;
  corners.forEach(([x1, y1], k) => {
    const [x0, y0] = corners.at(k - 1);
    if (y0 > y !== y1 > y && x < ((x0 - x1) * (y - y1)) / (y0 - y1) + x1) inside = !inside;
  });
  return inside;
}
