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
  cell: "",
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
  viewKeys = Object.entries(data.views).flatMap(([scope, part]) =>
    Object.keys(part.baselines).map((baseline) => `${scope}/${baseline}`),
  );
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
const viewKey = (choice = state) => axes.map((axis) => choice[axis]).join("/");
const view = () => viewOf(viewKey());
const single = (cell) => viewOf([state.metric, cell.world, cell.regime, state.baseline].join("/"));

// A view from its columns: those that all baselines of the scope share, and its own.
function viewOf(key) {
  if (views.has(key)) return views.get(key);
  const cut = key.lastIndexOf("/");
  const scope = data.views[key.slice(0, cut)];
  const own = scope && scope.baselines[key.slice(cut + 1)];
  if (!own) return undefined;
  const columns = { ...scope.shared, ...own.columns };
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
const keyOf = (cell) => `${cell.world}/${cell.regime}`;
const cellsInView = () =>
  data.cells.filter((cell) => ["world", "regime"].every((axis) => state[axis] === "all" || cell[axis] === state[axis]));
const order = () => view().rows.map((row) => looks[row.filter]);

// Choose a value of a switch. If the study has no such view, the nearest that exists is shown.
function choose(axis, value) {
  const wish = { ...state, [axis]: value };
  if (!viewKeys.includes(viewKey(wish))) {
    const place = axes.indexOf(axis);
    const score = (parts) => axes.reduce((sum, name, k) => sum + (parts[k] === wish[name] ? 1 : 0), 0);
    const near = viewKeys.map((key) => key.split("/")).filter((parts) => parts[place] === value);
    if (!near.length) return false;
    const best = near.reduce((a, b) => (score(b) > score(a) ? b : a));
    axes.forEach((name, k) => (wish[name] = best[k]));
  }
  Object.assign(state, Object.fromEntries(axes.map((name) => [name, wish[name]])));
  const cells = cellsInView().filter((cell) => data.curves[keyOf(cell)] || data.runs[keyOf(cell)]);
  if (cells.length && !cells.some((cell) => keyOf(cell) === state.cell)) selectCell(keyOf(cells[0]));
  return true;
}
function selectCell(key) {
  state.cell = key;
  state.run = null;
  state.filter = null;
}
function openView() {
  const first = viewKeys[0].split("/");
  axes.forEach((axis, k) => (state[axis] = first[k]));
  state.cell = Object.keys(data.curves)[0] || Object.keys(data.runs)[0] || "";
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
