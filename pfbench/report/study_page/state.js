// The data of the page and the view that is shown.
const state = {
  metric: "",
  world: "",
  regime: "",
  baseline: "",
  sort: "rank",
  down: false,
  open: null,
  on: new Set(),
  cell: null, // of data.cells
  run: null,
  filter: null,
};
const axes = ["metric", "world", "regime", "baseline"];
let data = null;
let looks = {};
let viewKeys = [];
const views = new Map(); // views that were shown, by key

async function unpack() {
  const bytes = Uint8Array.from(atob(find("#data").textContent.trim()), (sign) => sign.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  data = await new Response(stream).json();
  data.filters.forEach((look, index) => (look.index = index));
  looks = Object.fromEntries(data.filters.map((look) => [look.key, look]));
  const { keys, baselines } = data.views;
  viewKeys = keys.flatMap((scope) => baselines.map((baseline) => [...scope, baseline]));
}

// Numbers from levels of equal ratio (encoding.py). Level 0 is a missing value.
function decode(code) {
  if (code.values) return code.values;
  const text = atob(code.b);
  const wide = Boolean(code.w);
  const count = wide ? text.length / 2 : text.length;
  const range = wide ? 2 ** code.w : 256;
  const top = code.s ? range / 2 - 1 : range - 1;
  const step = Math.log(code.h / code.l) / (top - 1);
  const values = new Array(count);
  let level = 0;
  for (let k = 0; k < count; k++) {
    const raw = wide ? text.charCodeAt(k) * 256 + text.charCodeAt(k + count) : text.charCodeAt(k);
    level = code.d ? (level + raw) % range : raw;
    if (level === 0) values[k] = null;
    else if (!code.s) values[k] = code.l * Math.exp((level - 1) * step);
    else {
      const size = Math.abs(level - range / 2);
      values[k] = size === 0 ? 0 : Math.sign(level - range / 2) * code.l * Math.exp((size - 1) * step);
    }
  }
  return (code.values = values);
}

// The view: the choice of the switches, kept in the address after #.
const view = () => viewOf(axes.map((axis) => state[axis]));
const single = (cell) => viewOf([state.metric, cell.world, cell.regime, state.baseline]);

// A view from its columns: those that all baselines of the scope share, and its own.
function viewOf(wish) {
  const key = viewKeys.findIndex((parts) => parts.every((part, k) => part === wish[k]));
  if (views.has(key)) return views.get(key);
  if (key < 0) return undefined;
  const { baselines, texts, shared, separate } = data.views;
  const [scope, base] = [Math.floor(key / baselines.length), key % baselines.length];
  const own = texts[scope][base];
  const columns = {};
  for (const [name, values] of Object.entries(shared)) columns[name] = values[scope];
  for (const [name, values] of Object.entries(separate)) columns[name] = values[scope][base];
  const names = Object.keys(columns);
  const rows = (columns.filter || []).map((_, k) => Object.fromEntries(names.map((name) => [name, columns[name][k]])));
  const built = { ...own, rows, byFilter: Object.fromEntries(rows.map((row) => [row.filter, row])) };
  views.set(key, built);
  return built;
}
const metricOf = () => data.metrics.find((metric) => metric.key === state.metric);
const named = (items, key) => (items.find((item) => item.key === key) || { name: key }).name;
const cellName = (cell) =>
  data.regimes.length > 1
    ? `${named(data.worlds, cell.world)}, ${named(data.regimes, cell.regime)}`
    : named(data.worlds, cell.world);
// The part of a cell in data by world and regime, or undefined.
const partOf = (parts, cell) => cell && parts[cell.world]?.[cell.regime];
const hasRuns = (cell) => partOf(data.curves, cell) || partOf(data.runs, cell);
const cellsInView = () =>
  data.cells.filter((cell) => ["world", "regime"].every((axis) => state[axis] === "all" || cell[axis] === state[axis]));
const order = () => view().rows.map((row) => looks[row.filter]);

// Choose a value of a switch. If the study has no such view, the nearest that exists is shown.
function choose(axis, value) {
  const wish = { ...state, [axis]: value };
  const score = (parts) => axes.reduce((sum, name, k) => sum + (parts[k] === wish[name] ? 1 : 0), 0);
  if (!viewKeys.some((parts) => score(parts) === axes.length)) {
    const place = axes.indexOf(axis);
    const near = viewKeys.filter((parts) => parts[place] === value);
    if (!near.length) return false;
    const best = near.reduce((a, b) => (score(b) > score(a) ? b : a));
    axes.forEach((name, k) => (wish[name] = best[k]));
  }
  Object.assign(state, Object.fromEntries(axes.map((name) => [name, wish[name]])));
  const cells = cellsInView().filter(hasRuns);
  if (cells.length && !cells.includes(state.cell)) selectCell(cells[0]);
  return true;
}
function selectCell(cell) {
  state.cell = cell;
  state.run = null;
  state.filter = null;
}
function openView() {
  axes.forEach((axis, k) => (state[axis] = data.opening[k]));
  state.cell = data.cells.find(hasRuns) || null;
  followAddress();
  const rows = view().rows;
  const chosen = rows.filter((row, k) => looks[row.filter].proposed || row.filter === state.baseline || k === 0);
  state.on = new Set(chosen.slice(0, 9).map((row) => row.filter));
}
function followAddress() {
  const wish = new URLSearchParams(location.hash.slice(1));
  for (const axis of axes) if (wish.has(axis)) choose(axis, wish.get(axis));
  const sort = wish.get("sort") || "";
  if (heads().some((head) => head.key === sort.replace("-", ""))) {
    state.sort = sort.replace("-", "");
    state.down = sort.startsWith("-");
  }
}
function writeAddress() {
  const words = new URLSearchParams(axes.map((axis) => [axis, state[axis]]));
  if (state.sort !== "rank" || state.down) words.set("sort", (state.down ? "-" : "") + state.sort);
  history.replaceState(null, "", `#${words}`);
}
