"use strict";
// Texts, numbers, scales and marks. Everything that is drawn comes from here.
const find = (selector, part = document) => part.querySelector(selector);
const findAll = (selector, part = document) => [...part.querySelectorAll(selector)];
const escapes = { "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "'": "&#39;" };
const esc = (text) => String(text).replace(/[&<>"']/g, (sign) => escapes[sign]);
const strong = (text) => esc(text).replace(/\[\[(.*?)\]\](?!\])/g, "<b>$1</b>");

// Numbers with significant digits, as page_writer.py writes them.
function short(value, digits = 3) {
  if (value === null || value === undefined) return "–";
  if (value === Infinity) return "∞"; // the end of an interval that lost runs leave open
  const rounded = Number(value.toPrecision(digits));
  if (rounded === 0) return "0";
  const exponent = Math.floor(Math.log10(Math.abs(rounded)) + 1e-12);
  if (exponent < -4 || exponent >= 6) return rounded.toExponential(digits - 1).replace("e+", "e");
  return rounded.toFixed(Math.max(0, digits - 1 - exponent));
}
const tidy = (value) =>
  short(value, 6)
    .replace(/(\.\d*?)0+$/, "$1")
    .replace(/\.$/, "");
const percent = (share) => (share === null || share === undefined ? "–" : `${Math.round(Number((100 * share).toFixed(4)))} %`); // of single precision or double
const end = (value) => (short(value) !== "1.00" ? short(value) : value === 1 ? "1" : short(value, 4)); // exactly 1: a test stops there
const interval = (low, high) => (low === null || high === null || low === undefined ? "" : `[${end(low)}, ${end(high)}]`);
const change = (ratio, largest = ratio) => {
  const value = 100 * (ratio - 1);
  return largest >= 2 ? `${short(ratio)} ×` : `${value > 0 ? "+" : value < 0 ? "−" : ""}${short(Math.abs(value))} %`;
};

// Scales from values to pixels, and their ticks.
function linear(low, high, from, to) {
  const slope = (to - from) / (high - low || 1);
  return (value) => from + (value - low) * slope;
}
function logarithmic(low, high, from, to) {
  const scale = linear(Math.log(low), Math.log(high), from, to);
  return (value) => scale(Math.log(value));
}
function linearTicks(low, high, count) {
  const rough = (high - low) / Math.max(1, count) || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough * 0.999);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) ticks.push(k * step);
  return ticks;
}
function logTicks(low, high, count) {
  const decades = Math.log10(high / low);
  const factors = decades < 0.6 ? [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9] : decades < 2.2 ? [1, 2, 5] : [1];
  let ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) {
    for (const factor of factors) {
      const value = factor * 10 ** power;
      if (value >= low * 0.999 && value <= high * 1.001) ticks.push(value);
    }
  }
  const every = Math.ceil(ticks.length / Math.max(2, count));
  if (every > 1) ticks = ticks.filter((_, k) => k % every === 0);
  return ticks.length > 1 ? ticks : linearTicks(low, high, Math.min(count, 4));
}

// Marks: one path a shape, of half the size 1.
const star = [...Array(10).keys()].map((k) => {
  const r = k % 2 ? 0.5 : 1.25;
  return `${(r * Math.sin((k * Math.PI) / 5)).toFixed(2)} ${(-r * Math.cos((k * Math.PI) / 5)).toFixed(2)}`;
});
const polygon = (corners) =>
  `M${[...Array(corners).keys()]
    .map((k) => {
      const angle = (2 * Math.PI * k) / corners;
      return `${(1.1 * Math.sin(angle)).toFixed(2)} ${(-1.1 * Math.cos(angle)).toFixed(2)}`;
    })
    .join("L")}Z`;
const shapes = {
  o: "M-1 0A1 1 0 1 1 1 0A1 1 0 1 1 -1 0Z",
  s: "M-.9-.9H.9V.9H-.9Z",
  D: "M0-1.25 1.25 0 0 1.25-1.25 0Z",
  d: "M0-1.35.8 0 0 1.35-.8 0Z",
  "^": "M0-1.15 1.15.9H-1.15Z",
  v: "M0 1.15 1.15-.9H-1.15Z",
  "<": "M-1.15 0 .9-1.15V1.15Z",
  ">": "M1.15 0-.9-1.15V1.15Z",
  "*": `M${star.join("L")}Z`,
  p: polygon(5),
  h: polygon(6),
  8: polygon(8),
  P: "M-.4-1.1H.4V-.4H1.1V.4H.4V1.1H-.4V.4H-1.1V-.4H-.4Z",
  X: "M-1.1-.6-.6-1.1 0-.5.6-1.1 1.1-.6.5 0 1.1.6.6 1.1 0 .5-.6 1.1-1.1.6-.5 0Z",
};
// A filter's mark: filled if proposed, hollow if not.
function mark(look, x, y, size = 5, more = "") {
  const fill = look.proposed ? "var(--c)" : "var(--paper)";
  const path = shapes[look.marker] || shapes.o;
  return `<path class="c${look.index}" d="${path}" transform="translate(${px(x)} ${px(y)}) scale(${size})" fill="${fill}" stroke="var(--c)" stroke-width="1.6" vector-effect="non-scaling-stroke"${more}/>`;
}
const icon = (look) => `<svg class="mark" viewBox="-7.5 -6.5 15 13" aria-hidden="true">${mark(look, 0, 0, 5)}</svg>`;
const px = (value) => Math.round(10 * value) / 10;
const label = (x, y, text, more = "") => `<text x="${px(x)}" y="${px(y)}"${more}>${esc(text)}</text>`;
const line = (x1, y1, x2, y2, more) => `<line x1="${px(x1)}" y1="${px(y1)}" x2="${px(x2)}" y2="${px(y2)}"${more}/>`;
const bar = (x1, x2, y, width, look, opacity = 1) =>
  `<line class="c${look.index}" x1="${px(x1)}" x2="${px(x2)}" y1="${px(y)}" y2="${px(y)}" stroke="var(--c)" stroke-width="${width}" stroke-opacity="${opacity}"/>`;
const svg = (width, height, content, words, role = "img") =>
  `<svg viewBox="0 0 ${px(width)} ${px(height)}" width="${px(width)}" height="${px(height)}" role="${role}" aria-label="${esc(words)}">${content}</svg>`;
const tip = (words) => ` data-tip="${esc(words)}"`;
const spoken = (words) => ` data-tip="${esc(words)}" tabindex="0" role="img" aria-label="${esc(words)}"`;
const widthOf = (part) => Math.max(280, part.clientWidth || 640);

// Axes with lines across the figure.
function xAxis(ticks, scale, top, bottom, format = tidy) {
  return ticks
    .map(
      (v) =>
        line(scale(v), top, scale(v), bottom, ' class="grid"') +
        label(scale(v), bottom + 14, format(v), ' class="axis" text-anchor="middle"'),
    )
    .join("");
}
function yAxis(ticks, scale, left, right, format = tidy) {
  return ticks
    .map(
      (v) =>
        line(left, scale(v), right, scale(v), ' class="grid"') +
        label(left - 6, scale(v) + 4, format(v), ' class="axis" text-anchor="end"'),
    )
    .join("");
}

// Width of a text in px. Fonts differ between systems, so that it is measured.
const pen = document.createElement("canvas").getContext("2d");
function textWidth(text, size = 12, bold = false) {
  pen.font = `${bold ? 700 : 400} ${size}px system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif`;
  return pen.measureText(text).width;
}
// Lines of a text, none wider than the width, broken at blanks or, in a longer word, between letters. Nothing is left out.
function wrap(text, width, size = 12, bold = false) {
  const lines = [""];
  const fits = (line) => textWidth(line, size, bold) <= width;
  for (const word of String(text).split(" ")) {
    const last = lines.length - 1;
    const joined = lines[last] ? `${lines[last]} ${word}` : word;
    if (fits(joined)) {
      lines[last] = joined;
      continue;
    }
    if (lines[last]) lines.push("");
    for (const letter of word) {
      if (lines[lines.length - 1] && !fits(lines[lines.length - 1] + letter)) lines.push("");
      lines[lines.length - 1] += letter;
    }
  }
  return lines;
}
// A label of some lines around a height.
const block = (x, y, lines, size, more = "", bold = false) =>
  lines
    .map((text, k) =>
      label(x, y + 4 + (size + 1) * (k - (lines.length - 1) / 2), text, ` style="font-size:${size}px"${bold ? ' class="strong"' : ""}${more}`),
    )
    .join("");
// Column of the names of looks: its width, at most a share of the figure, and the height of a row.
function nameColumn(shown, width, size, least) {
  const widest = Math.max(...shown.map((look) => textWidth(look.name, size, look.proposed)));
  const column = Math.ceil(Math.min(widest + 14, 0.45 * width));
  const most = Math.max(...shown.map((look) => wrap(look.name, column - 12, size, look.proposed).length));
  return [column, Math.max(least, most > 1 ? (size + 1) * most + 3 : 0)];
}
const nameLabel = (look, x, y, column, size, more = "") =>
  block(x, y, wrap(look.name, column - 12, size, look.proposed), size, more, look.proposed);
// Heights of labels, moved apart so that none covers another.
function spread(heights, gap, low, high) {
  const order = heights.map((y, k) => [y, k]).sort((a, b) => a[0] - b[0]);
  let last = low - gap;
  for (const item of order) last = item[0] = Math.max(item[0], last + gap);
  let next = high + gap;
  for (const item of order.reverse()) next = item[0] = Math.min(item[0], next - gap);
  const moved = [];
  for (const [y, k] of order) moved[k] = y;
  return moved;
}
