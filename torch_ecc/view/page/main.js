// The page: what the server's state says is shown, and what people do is asked of the server.

import { Curves } from "./curves.js";
import { Link } from "./link.js";
import { Stage } from "./stage.js";
import { brief, colour, DEG, physical } from "./words.js";

const $ = (selector, within = document) => within.querySelector(selector);
const all = (selector) => document.querySelectorAll(selector);
const link = new Link();
const stage = new Stage($("#canvas"));
const curves = new Curves($(".charts"));

let state = null;
let cursor = 0; // the number of the frame that is shown
let following = false; // the run's last picture is shown, whichever it is
let loading = false; // a frame is on its way
let marking = 0; // how many changes of the marks are on their way to the server
let marked = []; // the marks as the server has them
let mapped = null; // the size and the frame of the map that is shown

const running = () => state?.run?.state === "running";
const um = () => state.settings.um_per_px ?? state.own.um_per_px;
const scales = () => [um()].flat(); // of x and of y, as far as they are known

// ---- what the server tells

link.addEventListener("down", () => ($("#line").textContent = "torch-ecc is not running any more"));
link.addEventListener("up", () => ($("#line").textContent = ""));
link.addEventListener("state", ({ detail }) => {
  const before = state;
  state = detail.state;
  marked = state.marks;
  if (marking > 0 && before) state.marks = before.marks; // ours are on their way
  $("#problem").hidden = state.problem === null;
  $("main").hidden = state.problem !== null;
  if (state.problem !== null) {
    $("#problem").textContent = state.problem;
    $("#what").textContent = state.input;
    return;
  }
  if (!before || before.first !== state.first || before.looks !== state.looks) show(state.first);
  if (running() && before?.run?.state !== "running") following = true;
  if (!running()) following = false;
  render();
});
link.addEventListener("rows", ({ detail }) => {
  curves.add(detail.data, detail.width, detail.new);
  if (detail.run && state) {
    state.run = { ...state.run, ...detail.run };
    renderProgress();
  }
  renderShown();
});
let decoding = null; // of the last picture
link.addEventListener("picture", ({ detail }) => {
  if (following && detail.row) decoding = showPicture(detail);
});
link.addEventListener("all", async () => {
  await decoding?.catch(() => null);
  const next = document.hidden ? (call) => setTimeout(call, 1000) : requestAnimationFrame;
  next(() => link.shown(stage.side()));
});

async function showPicture({ data, row }) {
  const image = await createImageBitmap(data);
  cursor = row[0];
  stage.setImage(image);
  renderShown(row);
}

// What is asked, and the server's sentence if it is refused.
async function ask(what, given) {
  try {
    const value = await link.ask(what, given);
    say(null);
    return value;
  } catch (error) {
    say(error.message);
    return null;
  }
}

function say(words) {
  $("#error").hidden = words === null;
  $("#error").textContent = words?.replace(/^\w+: (?=\w)/, (name) => name) ?? "";
}

// ---- the frame that is shown

async function show(number) {
  cursor = number;
  renderShown();
  if (loading) return; // one at a time: the last one that was asked for is fetched after it
  loading = true;
  let asked;
  do {
    asked = cursor;
    await fetchFrame(asked);
  } while (asked !== cursor);
  loading = false;
}

async function fetchFrame(number) {
  const answer = await fetch(`frame/${number}.jpg`).catch(() => null);
  if (!answer) return;
  if (answer.ok) {
    stage.setImage(await createImageBitmap(await answer.blob()));
    tell(number, "");
  } else tell(number, await answer.text());
}

const damage = new Map();
function tell(number, words) {
  if (words) damage.set(number, words);
  else damage.delete(number);
  renderShown();
}

function seek(number) {
  following = false;
  show(Math.max(0, state.length ? Math.min(number, state.length - 1) : number));
}

// ---- rendering

function render() {
  const [height, width] = state.size;
  document.title = `${state.name} – torch-ecc`;
  $("#what").textContent = [state.name, `${width} × ${height} px`, state.length && `${state.length} frames`, state.dtype]
    .filter(Boolean)
    .join(" · ");
  stage.setFrame(width, height);
  if (stage.selected >= Math.max(state.marks.length, state.tracked?.length ?? 0)) stage.selected = -1;
  curves.um = state.um_matrix;
  $("#slider").max = (state.length ?? 1) - 1;
  $("#look").hidden = !state.live || running();
  for (const name of ["#back", "#slider", "#on"]) $(name).hidden = state.live;
  renderMarks();
  renderScale();
  renderSettings();
  renderProgress();
  renderShown();
  $("#repeat").hidden = !state.ready;
  $("#command").textContent = state.command;
  $("#toml").textContent = state.toml;
  if ($("#map").checked) renderMap();
}

function renderMarks() {
  const table = $("#patches table");
  table.hidden = state.marks.length === 0;
  $("#patches .empty").hidden = state.marks.length > 0;
  $("#clear").hidden = state.marks.length < 2;
  $("#count").textContent = state.marks.length > 1 ? state.marks.length : "";
  for (const step of ["undo", "redo"]) $(`#${step}`).disabled = running() || !state[step];
  $("tbody", table).replaceChildren(...state.marks.map(row));
  if (state.marks.length > 8 && !table.parentElement.classList.contains("scroll")) {
    const scroll = document.createElement("div");
    scroll.className = "scroll";
    table.replaceWith(scroll);
    scroll.append(table);
  }
  renderSelected();
}

function row(mark, number) {
  const { sigma, words } = state.outlooks[number] ?? { sigma: null, words: null };
  const line = document.createElement("tr");
  line.setAttribute("aria-selected", number === stage.selected);
  line.dataset.sigma = JSON.stringify(sigma);
  const dot = document.createElement("span");
  dot.className = "dot";
  dot.style.background = colour(number);
  const size = mark.points ? "outline" : `${mark.w}×${mark.h}`;
  const cells = !sigma // not fixed, or the server has not said yet
    ? [[`${number}`], [size], [words ?? "…"]]
    : [
        [`${number}`],
        [size],
        [brief(sigma[0]), physical(sigma[0], scales()[0])],
        [brief(sigma[1]), physical(sigma[1], scales().at(-1))],
        [brief(sigma[2] * DEG)],
      ];
  for (const [text, small] of cells) {
    const cell = line.insertCell();
    cell.append(text);
    if (small) cell.append(Object.assign(document.createElement("small"), { textContent: small }));
  }
  line.cells[0].prepend(dot, " ");
  if (!sigma) Object.assign(line.cells[2], { colSpan: 3, className: words ? "words" : "" });
  const remove = Object.assign(document.createElement("button"), { type: "button", className: "plain", textContent: "×" });
  remove.setAttribute("aria-label", `Remove patch ${number}`);
  remove.disabled = running();
  remove.onclick = (event) => {
    event.stopPropagation();
    stage.remove(number);
  };
  line.insertCell().append(remove);
  line.onclick = () => stage.select(number);
  return line;
}

function renderSelected() {
  const mark = state.marks[stage.selected];
  const form = $("#selected");
  form.hidden = !mark || !!mark.points || !stage.editable;
  if (!form.hidden && !form.contains(document.activeElement)) for (const name of ["x", "y", "w", "h"]) form[name].value = mark[name];
  all("#patches tbody tr").forEach((line, number) => line.setAttribute("aria-selected", number === stage.selected));
  curves.selected = Math.max(stage.selected, 0);
  curves.draw();
  renderChips();
}

function renderScale() {
  const form = $("#unit");
  const [x, y] = scales();
  if (document.activeElement !== form.um_per_px) form.um_per_px.value = [state.settings.um_per_px].flat()[0] ?? "";
  form.um_per_px.placeholder = state.own.um_per_px ? brief(state.own.um_per_px[0]) : "unknown";
  const told = !state.settings.um_per_px && state.own.um_per_px;
  $("#own").textContent = told
    ? `${brief(x)}${y && y !== x ? ` in x, ${brief(y)} in y` : ""}, as the file says.`
    : um() ? "" : "Without it results are in px. Scale, above the picture: drag along something of known length.";
}

function renderSettings() {
  const form = $("#settings");
  for (const name of ["frames", "fps", "out"])
    if (document.activeElement !== form[name]) form[name].value = state.settings[name] ?? "";
  form.fps.placeholder = state.own.fps ? brief(state.own.fps) : "unknown";
  form.out.placeholder = state.folder;
  form.overlay.checked = state.settings.overlay;
  form.force.checked = !!state.settings.force;
  $("#replace").hidden = state.there === "nothing";
  const there = { unfinished: "An unfinished run is there: Go on ends it.", result: "A result is there already." }[state.there];
  $("#there").hidden = !there || running() || state.run?.state === "done";
  $("#there").textContent = there ?? "";
}

function renderProgress() {
  const run = state.run;
  stage.editable = !running() && cursor === state.first;
  $("#track").hidden = running();
  $("#track").disabled = !state.ready;
  $("#stop").hidden = !running();
  if (!running()) Object.assign($("#stop"), { disabled: false, textContent: "Stop" });
  $("#resume").hidden = running() || state.there !== "unfinished";
  $("#track").className = $("#resume").hidden ? "main" : ""; // what is likely to be meant
  const bar = $("#progress");
  bar.hidden = !running();
  if (run?.total) Object.assign(bar, { max: run.total, value: run.done });
  else bar.removeAttribute("value");
  $("#progressed").textContent = run ? `${run.done}${run.total ? ` of ${run.total}` : ""} frames, ${brief(run.rate)} per second` : "";
  const words = [...(run?.words ?? state.notes ?? []), ...(run?.latency ?? [])];
  $("#words").replaceChildren(...words.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  $("#words").className = run?.state === "failed" ? "bad" : "";
  $("#files").hidden = running() || state.files.length === 0;
  if (!$("#files").hidden) $("#files").replaceChildren("Download: ", ...["all.zip", ...state.files].map(download));
}

function download(name) {
  return Object.assign(document.createElement("a"), { href: `files/${name}`, download: "", textContent: name === "all.zip" ? "all" : name });
}

function renderChips() {
  const chips = $("#chips");
  const count = state.start?.length ?? 0;
  if (chips.childElementCount !== (count > 1 ? Math.min(count, 24) : 0))
    chips.replaceChildren(
      ...Array.from({ length: count > 1 ? Math.min(count, 24) : 0 }, (_, number) => {
        const chip = Object.assign(document.createElement("button"), { type: "button", onclick: () => stage.select(number) });
        const dot = Object.assign(document.createElement("span"), { className: "dot" });
        dot.style.background = colour(number);
        chip.append(dot, `${number}`);
        return chip;
      }),
    );
  [...chips.children].forEach((chip, number) => chip.setAttribute("aria-pressed", number === curves.selected));
}

// The poses in the frame that is shown, in the picture, as words, and in the curves.
function renderShown(exact = null) {
  if (!state || state.problem !== null) return;
  $("#curves").hidden = curves.rows.length === 0;
  const near = exact ?? curves.at(cursor);
  const found = near && near[0] === cursor ? near : null;
  stage.editable = !running() && cursor === state.first;
  const fresh = cursor === state.first && !running(); // what is marked is shown, else what the rows are of
  stage.marks = fresh ? state.marks : (state.tracked ?? state.marks);
  stage.starts = fresh ? null : state.start;
  stage.poses = found && !fresh ? stage.marks.map((_, r) => pose(found, r)) : null;
  stage.doubted = found && !fresh ? stage.marks.map((_, r) => found[11 + 10 * r] > 0) : [];
  stage.draw();
  curves.cursor = found ? cursor : null;
  curves.draw();
  $("#slider").value = cursor;
  $("#number").textContent = `${cursor}${state.length ? ` of ${state.length - 1}` : ""}`;
  $("#follow").hidden = !running() || following;
  $("#elsewhere").hidden = running() || cursor === state.first || curves.rows.length > 0;
  $("#elsewhere b").textContent = state.first;
  renderSelectedForm();
  describe(found);
}

function renderSelectedForm() {
  const mark = state.marks[stage.selected];
  $("#selected").hidden = !mark || !!mark.points || !stage.editable;
}

function pose(row, r) {
  const k = 2 + 10 * r;
  const values = [row[k], row[k + 1], row[k + 2]];
  return values.every((value) => value !== null && Number.isFinite(value)) ? values : null;
}

let described = null;
async function describe(found) {
  if (damage.has(cursor)) {
    described = null;
    $("#said").innerHTML = "";
    $("#said").append(Object.assign(document.createElement("b"), { className: "bad", textContent: `Frame ${cursor}: ${damage.get(cursor)}` }));
    return;
  }
  if (!found) {
    described = null;
    $("#said").textContent = "";
    return;
  }
  const number = cursor;
  const r = Math.min(stage.selected < 0 ? 0 : stage.selected, state.start.length - 1);
  const k = 2 + 10 * r;
  const doubted = found[k + 9] > 0;
  const time = Number.isFinite(found[1]) && found[1] !== null ? `, ${found[1].toFixed(3)} s` : "";
  const text = `Frame ${number}${time}, patch ${r}: score ${found[k + 6].toFixed(4)}, coverage ${Math.round(found[k + 7] * 100)} %.`;
  if (!doubted || following) {
    described = null;
    $("#said").textContent = text;
    return;
  }
  const key = `${number}/${r}`;
  if (described === key) return;
  described = key;
  const answer = await link.ask("row", { number }).catch(() => null);
  if (described !== key || !answer) return;
  $("#said").textContent = `${text} `;
  $("#said").append(Object.assign(document.createElement("b"), { className: "bad", textContent: answer.reasons[r] }));
}

// ---- the map of trackability

async function renderMap() {
  const size = Number($("#many").size.value);
  const key = `${size}/${state.looks}`;
  if (mapped === key) return;
  mapped = key;
  const found = await ask("map", { size });
  if (mapped !== key) return;
  if (!found) return hideMap();
  const image = new OffscreenCanvas(found.columns, found.rows);
  const context = image.getContext("2d");
  const pixels = context.createImageData(found.columns, found.rows);
  const finite = [...found.data].filter(Number.isFinite).sort((a, b) => a - b);
  const [low, high] = [finite[0] ?? 1, finite[Math.floor(0.98 * (finite.length - 1))] ?? 2].map(Math.log);
  found.data.forEach((value, k) => {
    const part = Math.min(Math.max((Math.log(value) - low) / (high - low || 1), 0), 1);
    pixels.data.set(Number.isFinite(value) ? [...heat(part), 255] : [70, 12, 20, 255], 4 * k);
  });
  context.putImageData(pixels, 0, 0);
  stage.overlay = { image, x: found.x, y: found.y };
  stage.draw();
  $("#legend").hidden = false;
  const [best, worst] = $("#legend").querySelectorAll("span");
  best.textContent = `σ ${brief(Math.exp(low))} px`;
  worst.textContent = `${brief(Math.exp(high))} px; darkest: no texture`;
  $("#legend i").style.background = `linear-gradient(90deg, ${[0, 0.25, 0.5, 0.75, 1].map((t) => `rgb(${heat(t)})`)})`;
}

function hideMap() {
  mapped = null;
  stage.overlay = null;
  $("#legend").hidden = true;
  $("#map").checked = false;
  stage.draw();
}

// From good, light green, by yellow to bad, red: lightness falls all the way, for whoever sees no colours.
const STOPS = [[190, 255, 170], [235, 230, 80], [245, 160, 50], [205, 75, 45], [125, 25, 40]];
function heat(part) {
  const at = part * (STOPS.length - 1);
  const k = Math.min(Math.floor(at), STOPS.length - 2);
  return STOPS[k].map((value, c) => Math.round(value + (STOPS[k + 1][c] - value) * (at - k)));
}

// ---- what people do

stage.addEventListener("change", ({ detail: marks }) => mark(marks));

async function mark(marks) {
  state.marks = marks;
  marking++;
  await ask("mark", { marks });
  if (--marking > 0) return;
  state.marks = marked;
  render();
}
stage.addEventListener("select", () => {
  described = null;
  renderSelected();
  renderShown();
});

// While something is dragged its outlook is asked for, one question at a time, always of the last one.
let draft = null;
let predicting = false;
stage.addEventListener("draft", async ({ detail }) => {
  draft = detail?.mark ?? null;
  if (detail?.length) tip(`${detail.length.toFixed(1)} px`);
  else if (!draft) tip(null);
  if (!draft || predicting) return;
  predicting = true;
  while (draft) {
    const asked = draft;
    const found = await link.ask("predict", { mark: asked }).catch((error) => ({ words: error.message }));
    if (draft) renderDraft(draft, found);
    if (asked === draft) break;
  }
  predicting = false;
});

function renderDraft(mark, { sigma, words }) {
  const size = mark.points ? `${mark.points.length} corners` : `${mark.w} × ${mark.h} px`;
  if (words) return tip(words, true);
  const [x, y] = [0, 1].map((k) => `${brief(sigma[k])} px  ${physical(sigma[k], scales().at(-k))}`);
  tip(`${size}\nσ of x  ${x}\nσ of y  ${y}\nσ of θ  ${brief(sigma[2] * DEG)}°`);
}

let pointer = [0, 0];
$("#canvas").addEventListener("pointermove", (event) => {
  pointer = [event.offsetX, event.offsetY];
  placeTip();
});

function tip(words, bad = false) {
  const element = $("#tip");
  element.hidden = words === null;
  element.className = bad ? "bad" : "";
  element.textContent = words ?? "";
  placeTip();
}

function placeTip() {
  const element = $("#tip");
  if (element.hidden) return;
  const { clientWidth: w, clientHeight: h } = $("#canvas");
  element.style.left = `${Math.max(Math.min(pointer[0] + 16, w - element.offsetWidth - 6), 0)}px`;
  element.style.top = `${Math.max(Math.min(pointer[1] + 16, h - element.offsetHeight - 6), 0)}px`;
}

let drawn = null; // px: the line of known length
stage.addEventListener("length", ({ detail }) => {
  drawn = detail;
  $("#length").hidden = false;
  $("#length b").textContent = detail.toFixed(1);
  $("#unit").um.focus();
});
$("#unit").onsubmit = (event) => event.preventDefault();
$("#unit").um.onchange = ({ target }) => {
  if (target.value > 0) ask("set", { settings: { um_per_px: Number((target.value / drawn).toPrecision(6)) } });
  $("#length").hidden = true;
  target.value = "";
  setTool("box");
};
$("#unit").um_per_px.onchange = ({ target }) => ask("set", { settings: { um_per_px: target.value ? Number(target.value) : null } });

function setTool(tool) {
  stage.setTool(tool);
  all("[data-tool]").forEach((button) => button.setAttribute("aria-pressed", button.dataset.tool === tool));
}
all("[data-tool]").forEach((button) => (button.onclick = () => setTool(button.dataset.tool)));
$("#in").onclick = () => stage.zoom(1.5);
$("#out").onclick = () => stage.zoom(1 / 1.5);
$("#fit").onclick = () => stage.fit();
$("#map").onchange = ({ target }) => (target.checked ? renderMap() : hideMap());
$("#many").size.onchange = () => $("#map").checked && renderMap();
$("#slider").oninput = ({ target }) => seek(Number(target.value));
$("#back").onclick = () => seek(cursor - 1);
$("#on").onclick = () => seek(cursor + 1);
$("#follow").onclick = () => ((following = true), renderShown());
$("#look").onclick = () => ask("look");
$("#here").onclick = () => ask("set", { settings: { frames: `${cursor}:` } });
$("#clear").onclick = () => mark([]);
for (const step of ["undo", "redo"]) $(`#${step}`).onclick = () => !running() && ask(step);
curves.addEventListener("seek", ({ detail }) => seek(detail));

$("#selected").onsubmit = (event) => event.preventDefault();
$("#selected").onchange = ({ target }) => {
  const changed = { ...state.marks[stage.selected], [target.name]: Number(target.value) };
  mark(state.marks.with(stage.selected, changed));
};
$("#many").onsubmit = (event) => {
  event.preventDefault();
  const [size, count] = [Number(event.target.size.value), Number(event.target.count.value)];
  if (event.submitter.value !== "one") return ask(event.submitter.value, { count, size });
  const [x, y] = stage.middle();
  stage.selected = state.marks.length;
  mark([...state.marks, { x, y, w: size, h: size }]);
};
$("#paste").onsubmit = async (event) => {
  event.preventDefault();
  const form = event.target;
  if ((await ask("outline", { text: form.text.value })) !== null || $("#error").hidden) form.text.value = "";
};
// Files of ImageJ's regions: dropped anywhere, chosen, or pasted.
async function readRois(files) {
  for (const file of files) {
    const bytes = new Uint8Array(await file.arrayBuffer());
    const data = btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
    if ((await ask("rois", { name: file.name, data })) === null && !$("#error").hidden) return;
  }
}
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  if (!running()) readRois(event.dataTransfer.files);
});
addEventListener("paste", ({ clipboardData }) => !running() && readRois(clipboardData.files));
$("#roi").onchange = async ({ target }) => {
  await readRois([...target.files]);
  target.value = ""; // the same file may be chosen again
};
$("#settings").onsubmit = (event) => event.preventDefault();
$("#settings").onchange = ({ target }) => {
  const value = target.type === "checkbox" ? target.checked : target.value === "" ? null : target.type === "number" ? Number(target.value) : target.value;
  ask("set", { settings: { [target.name]: value } });
};
$("#track").onclick = () => ask("track");
$("#stop").onclick = ({ target }) => {
  Object.assign(target, { disabled: true, textContent: "Stopping ..." }); // the files are made whole
  ask("stop");
};
$("#resume").onclick = () => ask("track", { resume: true });
all("[data-copy]").forEach((button) => {
  button.onclick = async () => {
    await navigator.clipboard.writeText(state[button.dataset.copy]);
    button.textContent = "Copied";
    setTimeout(() => (button.textContent = "Copy"), 1500);
  };
});

addEventListener("keydown", (event) => {
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z" && !event.target.matches("input, textarea")) {
    $(event.shiftKey ? "#redo" : "#undo").click();
    return event.preventDefault();
  }
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, textarea, select")) return;
  const tool = { r: "box", p: "outline", s: "scale", h: "pan" }[event.key.toLowerCase()];
  if (tool) setTool(tool);
  else if (event.key === "+" || event.key === "=") stage.zoom(1.25);
  else if (event.key === "-") stage.zoom(0.8);
  else if (event.key === "0") stage.fit();
  else if (event.key === "PageDown") seek(cursor + 1);
  else if (event.key === "PageUp") seek(cursor - 1);
  else return;
  event.preventDefault();
});

setTool("box");
