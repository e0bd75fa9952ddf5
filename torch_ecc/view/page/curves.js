// x, y and theta with their sigma, score and coverage, over time: a picture each, drawn from rows of numbers.

import { DEG, ink } from "./words.js";

const WIDTH = 10; // numbers of a template in a row, after the frame's number and its time: see history.py
const MOST = 20000; // rows that are kept
const DRAWN = 1600; // rows that are drawn, some two for each px, and those that are doubted
const OTHERS = 48; // templates that are drawn beside the selected one

export class Curves extends EventTarget {
  rows = [];
  selected = 0;
  cursor = null; // the number of the frame that is shown
  um = null; // (2, 2) px to micrometres
  #charts = [];
  #templates = 0;
  #shown = []; // the rows that are drawn

  constructor(element) {
    super();
    for (const [title, low] of [["x"], ["y"], ["theta"], ["score", true], ["coverage", true]]) {
      const figure = document.createElement("figure");
      figure.className = low ? "chart low" : "chart";
      figure.innerHTML = "<figcaption><span></span><span></span></figcaption><canvas></canvas>";
      const [canvas, [name, value]] = [figure.querySelector("canvas"), figure.querySelectorAll("span")];
      canvas.tabIndex = 0;
      canvas.setAttribute("role", "img");
      canvas.addEventListener("click", (event) => this.#click(event, canvas));
      canvas.addEventListener("keydown", (event) => this.#key(event));
      element.append(figure);
      this.#charts.push({ title, canvas, name, value });
    }
    new ResizeObserver(() => this.draw()).observe(element);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  add(data, width, anew) {
    if (anew) this.rows = [];
    for (let k = 0; k < data.length; k += width) this.rows.push(data.subarray(k, k + width));
    this.#templates = (width - 2) / WIDTH;
    if (this.rows.length > MOST) this.rows = this.rows.filter((row, k) => k % 2 === 0 || this.#isDoubted(row));
    this.draw();
  }

  #isDoubted(row) {
    for (let r = 0; r < this.#templates; r++) if (row[11 + WIDTH * r] > 0) return true;
    return false;
  }

  #isOdd(row) {
    return this.selected < this.#templates && row[11 + WIDTH * this.selected] > 0;
  }

  // The row of a frame, or of the one before it that is nearest.
  at(number) {
    let [low, high] = [0, this.rows.length - 1];
    if (high < 0 || this.rows[0][0] > number) return null;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.rows[middle][0] <= number) low = middle;
      else high = middle - 1;
    }
    return this.rows[low];
  }

  // One quantity of a template in a row, in the unit that it is drawn in, and its sigma.
  #value(row, template, title) {
    const k = 2 + WIDTH * template;
    if (title === "theta") return [row[k + 2] * DEG, row[k + 5] * DEG];
    if (title === "score") return [row[k + 6], 0];
    if (title === "coverage") return [row[k + 7], 0];
    const axis = title === "x" ? 0 : 1;
    if (!this.um) return [row[k + axis], row[k + 3 + axis]];
    const [a, b] = this.um[axis];
    return [a * row[k] + b * row[k + 1], Math.hypot(a * row[k + 3], b * row[k + 4])];
  }

  #unit(title) {
    return title === "theta" ? "°" : title === "score" || title === "coverage" ? "" : this.um ? "µm" : "px";
  }

  #time(row) {
    return Number.isNaN(this.rows[0][1]) ? row[0] : row[1];
  }

  draw() {
    this.#pending ??= requestAnimationFrame(() => {
      this.#pending = null;
      const every = Math.ceil(this.rows.length / DRAWN);
      this.#shown = every < 2 ? this.rows : this.rows.filter((row, k) => k % every === 0 || k === this.rows.length - 1 || this.#isOdd(row));
      for (const chart of this.#charts) this.#paint(chart);
    });
  }
  #pending = null;

  #paint(chart) {
    const { canvas, title } = chart;
    const { clientWidth: w, clientHeight: h } = canvas;
    if (!w || !this.rows.length) return;
    canvas.width = Math.round(w * devicePixelRatio);
    canvas.height = Math.round(h * devicePixelRatio);
    const context = canvas.getContext("2d");
    context.scale(devicePixelRatio, devicePixelRatio);
    const plot = { left: 66, right: w - 8, top: 6, bottom: h - 16 };
    const span = [this.#time(this.rows[0]), this.#time(this.rows.at(-1))];
    const range = this.#range(title);
    const x = (time) => plot.left + ((time - span[0]) / (span[1] - span[0] || 1)) * (plot.right - plot.left);
    const y = (value) => plot.bottom - ((value - range[0]) / (range[1] - range[0])) * (plot.bottom - plot.top);
    chart.x = { plot, span };
    this.#paintAxes(context, plot, span, range, x, y);
    context.save();
    context.beginPath();
    context.rect(plot.left, 0, plot.right - plot.left, h);
    context.clip();
    const others = Math.min(this.#templates, OTHERS);
    for (let r = 0; r < others; r++) if (r !== this.selected) this.#paintCurve(context, title, r, x, y, plot);
    if (this.selected < this.#templates) this.#paintCurve(context, title, this.selected, x, y, plot);
    context.restore();
    this.#say(chart);
    const row = this.cursor === null ? null : this.at(this.cursor);
    if (!row) return;
    context.strokeStyle = css("--ink");
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(x(this.#time(row)), plot.top);
    context.lineTo(x(this.#time(row)), plot.bottom);
    context.stroke();
  }

  #say({ title, name, value, canvas }) {
    const row = this.cursor === null ? this.rows.at(-1) : this.at(this.cursor);
    const words = { x: "x, displacement", y: "y, displacement", theta: "θ" };
    name.textContent = words[title] ?? title;
    if (!row || this.selected >= this.#templates) return;
    const [now, sigma] = this.#value(row, this.selected, title);
    const unit = this.#unit(title);
    const digits = sigma > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(sigma)), 0), 7) : 3;
    value.textContent = Number.isNaN(now) ? "not found" : `${now.toFixed(digits)}${sigma > 0 ? ` ± ${sigma.toFixed(digits)}` : ""} ${unit}`;
    canvas.setAttribute("aria-label", `${name.textContent}: ${value.textContent}. Arrow keys go from frame to frame.`);
  }

  #range(title) {
    let [low, high] = [Infinity, -Infinity];
    for (const row of this.#shown)
      for (let r = 0; r < this.#templates; r++) {
        if (r >= OTHERS && r !== this.selected) continue;
        const [value, sigma] = this.#value(row, r, title);
        if (Number.isNaN(value)) continue;
        const spread = r === this.selected && Number.isFinite(sigma) ? sigma : 0;
        low = Math.min(low, value - spread);
        high = Math.max(high, value + spread);
      }
    if (low > high) return [0, 1];
    if (title === "score" || title === "coverage") [low, high] = [Math.min(low, 0.9), 1];
    const margin = (high - low) * 0.06 || 0.5 * Math.abs(high) || 1;
    return [low - margin, high + margin];
  }

  #paintAxes(context, plot, span, range, x, y) {
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = css("--soft");
    context.strokeStyle = css("--line");
    context.lineWidth = 1;
    context.textAlign = "right";
    let step = nice((range[1] - range[0]) / Math.max((plot.bottom - plot.top) / 30, 1.2));
    while (Math.floor(range[1] / step) <= Math.ceil(range[0] / step)) step = nice(step / 2.5); // one line has no scale
    for (let v = Math.ceil(range[0] / step) * step; v <= range[1]; v += step) {
      context.beginPath();
      context.moveTo(plot.left, y(v));
      context.lineTo(plot.right, y(v));
      context.stroke();
      context.fillText(tick(v, step), plot.left - 6, y(v) + 4);
    }
    context.textAlign = "center";
    const wide = nice((span[1] - span[0] || 1) / Math.max((plot.right - plot.left) / 90, 1));
    const unit = Number.isNaN(this.rows[0][1]) ? "" : " s";
    for (let t = Math.ceil(span[0] / wide) * wide; t <= span[1]; t += wide)
      context.fillText(tick(t, wide) + unit, Math.min(Math.max(x(t), plot.left + 10), plot.right - 12), plot.bottom + 13);
  }

  // A line with gaps where the template was not found, its band of one sigma, and a tick below each row that is doubted.
  #paintCurve(context, title, template, x, y, plot) {
    const path = new Path2D();
    const [above, below] = [[], []];
    const band = new Path2D();
    const close = () => {
      if (above.length) [...above, ...below.reverse()].forEach((p, k) => band[k ? "lineTo" : "moveTo"](...p));
      above.length = below.length = 0;
    };
    let drawing = false;
    context.fillStyle = css("--bad");
    for (const row of this.#shown) {
      const [value, sigma] = this.#value(row, template, title);
      const at = x(this.#time(row));
      if (row[11 + WIDTH * template] > 0 && template === this.selected) context.fillRect(at - 0.75, plot.bottom - 5, 1.5, 5);
      if (Number.isNaN(value)) {
        drawing = false;
        close();
        continue;
      }
      path[drawing ? "lineTo" : "moveTo"](at, y(value));
      drawing = true;
      if (sigma > 0 && Number.isFinite(sigma)) {
        above.push([at, y(value + sigma)]);
        below.push([at, y(value - sigma)]);
      }
    }
    close();
    context.strokeStyle = context.fillStyle = ink(template);
    if (template === this.selected) {
      context.globalAlpha = 0.3;
      context.fill(band);
    }
    context.globalAlpha = template === this.selected ? 1 : 0.45;
    context.lineWidth = template === this.selected ? 1.8 : 1;
    context.stroke(path);
    context.globalAlpha = 1;
  }

  #click(event, canvas) {
    const chart = this.#charts.find((each) => each.canvas === canvas);
    if (!chart.x) return;
    const { plot, span } = chart.x;
    const time = span[0] + ((event.offsetX - plot.left) / (plot.right - plot.left)) * (span[1] - span[0]);
    let best = this.rows[0];
    for (const row of this.rows) if (Math.abs(this.#time(row) - time) < Math.abs(this.#time(best) - time)) best = row;
    this.#seek(best[0]);
  }

  #key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step || !this.rows.length) return;
    event.preventDefault();
    const here = this.at(this.cursor ?? this.rows.at(-1)[0]) ?? this.rows[0];
    const row = this.rows[this.rows.indexOf(here) + step];
    if (row) this.#seek(row[0]);
  }

  #seek(number) {
    this.dispatchEvent(new CustomEvent("seek", { detail: number }));
  }
}

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);

function nice(step) {
  const power = 10 ** Math.floor(Math.log10(step));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= step * 0.999);
}

function tick(value, step) {
  return (Math.abs(value) < step / 1e6 ? 0 : value).toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
}
