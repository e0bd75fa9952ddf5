// Numbers as people read them.

export const COLOURS = ["#4cc38a", "#5aa9ff", "#ffb224", "#e879c6", "#b79cff", "#3fd0d4", "#ff8a5b", "#c3d94e"];
const ON_PAPER = ["#0f7a48", "#1257b8", "#9a5b00", "#a3247f", "#6139c4", "#0a7176", "#b3400f", "#66700c"];
const dark = matchMedia("(prefers-color-scheme: dark)");

// Of a template over a picture, and on the page.
export const colour = (number) => COLOURS[number % COLOURS.length];
export const ink = (number) => (dark.matches ? COLOURS : ON_PAPER)[number % COLOURS.length];
export const DEG = 180 / Math.PI;

// Two significant digits: 0.0031, 0.12, 14.
export function brief(value) {
  if (value === null || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const digits = Math.max(0, 1 - Math.floor(Math.log10(Math.abs(value))));
  return value.toFixed(Math.min(digits, 9));
}

// Of a sigma in px: what it is in micrometres or nanometres, if the scale is known.
export function physical(px, um) {
  if (!um) return "";
  const size = Math.abs(px * um);
  return size < 0.1 ? `${brief(size * 1000)} nm` : `${brief(size)} µm`;
}
