// The data of the page and the view that is shown.
const state = {
  metric: "",
  world: "",
  regime: "",
  baseline: "",
  budget: "",
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

// The data are a JSON text in gzip and base 64 (page_writer.py).
async function unpack() {
  const packed = atob(find("#data").textContent.trim());
  const bytes = Uint8Array.from(packed, (sign) => sign.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const open = (_, value) => (value === "∞" ? Infinity : value); // JSON has no infinity
  data = JSON.parse(await new Response(stream).text(), open);
  data.filters.forEach((look, index) => (look.index = index));
  looks = Object.fromEntries(data.filters.map((look) => [look.key, look]));
  viewKeys = data.views.keys;
}

// The view: the choice of the switches, kept in the address after #.
const budgetOf = () => data.budgets.find((budget) => budget.key === state.budget) || {};
function view() {
  const whole = viewOf(axes.map((axis) => state[axis]));
  const { filters } = budgetOf();
  return filters ? { ...whole, rows: whole.rows.filter((row) => filters.includes(row.filter)) } : whole;
}
const single = (cell) => viewOf([state.metric, cell.world, cell.regime, state.baseline]);

// A view from its rows, each a list of values.
function viewOf(wish) {
  const key = viewKeys.findIndex((parts) => parts.every((part, k) => part === wish[k]));
  if (views.has(key)) return views.get(key);
  if (key < 0) return undefined;
  const { columns, texts, rows: stored } = data.views;
  const rows = stored[key].map((values) => Object.fromEntries(columns.map((name, k) => [name, values[k]])));
  const built = { ...texts[key], rows, byFilter: Object.fromEntries(rows.map((row) => [row.filter, row])) };
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
  state.budget = (data.budgets.find((budget) => !budget.reason_missing && !budget.filters) || {}).key || "";
  state.cell = data.cells.find(hasRuns) || null;
  followAddress();
  const rows = view().rows;
  const chosen = rows.filter((row, k) => looks[row.filter].proposed || row.filter === state.baseline || k === 0);
  state.on = new Set(chosen.slice(0, 9).map((row) => row.filter));
}
function followAddress() {
  const wish = new URLSearchParams(location.hash.slice(1));
  for (const axis of axes) if (wish.has(axis)) choose(axis, wish.get(axis));
  chooseBudget(wish.get("budget"));
  const sort = wish.get("sort") || "";
  if (heads().some((head) => head.key === sort.replace("-", ""))) {
    state.sort = sort.replace("-", "");
    state.down = sort.startsWith("-");
  }
}
function chooseBudget(key) {
  if (data.budgets.some((budget) => budget.key === key && !budget.reason_missing)) state.budget = key;
}
function writeAddress() {
  const words = new URLSearchParams(axes.map((axis) => [axis, state[axis]]));
  if (budgetOf().filters) words.set("budget", state.budget);
  if (state.sort !== "rank" || state.down) words.set("sort", (state.down ? "-" : "") + state.sort);
  history.replaceState(null, "", `#${words}`);
}
