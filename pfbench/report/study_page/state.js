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
let places = []; // scenario and regime of the views
const placeOf = (key) => key.slice(1, 3).join("/");
const views = new Map(); // views that were shown, by key

// The data are the length of a JSON text, the text and the bytes of all codes, in gzip and base 85 (encoding.py).
async function unpack() {
  const stream = new Blob([fromBase85(find("#data").textContent.trim())]).stream();
  const bytes = new Uint8Array(await new Response(stream.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer());
  const end = 4 + new DataView(bytes.buffer).getUint32(0);
  data = JSON.parse(new TextDecoder().decode(bytes.subarray(4, end)));
  placeCodes(data, bytes.subarray(end), 0);
  data.filters.forEach((look, index) => (look.index = index));
  looks = Object.fromEntries(data.filters.map((look) => [look.key, look]));
  const { keys, baselines } = data.views;
  places = [...new Set(keys.map(placeOf))];
  viewKeys = keys.flatMap((scope) => baselines.map((baseline) => [...scope, baseline]));
}

function fromBase85(text) {
  const signs = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%.()*+-;,=>?@^_`{|}~";
  const digits = new Uint8Array(128);
  [...signs].forEach((sign, digit) => (digits[sign.charCodeAt(0)] = digit));
  const missing = (5 - (text.length % 5)) % 5; // of the last group, and of its bytes
  const whole = text + "~".repeat(missing);
  const words = new DataView(new ArrayBuffer((whole.length / 5) * 4));
  for (let k = 0; k < whole.length; k += 5) {
    let word = 0;
    for (let n = k; n < k + 5; n++) word = word * 85 + digits[whole.charCodeAt(n)];
    words.setUint32((k / 5) * 4, word);
  }
  return words.buffer.slice(0, words.byteLength - missing);
}

// Replace the length of each code by its bytes. They lie in the order of the codes in the text.
function placeCodes(value, bytes, start) {
  if (value === null || typeof value !== "object") return start;
  if (typeof value.code === "number") {
    const end = start + value.code;
    value.code = bytes.subarray(start, end);
    return end;
  }
  return Object.values(value).reduce((place, part) => placeCodes(part, bytes, place), start);
}

// Exact numbers of four digits, or numbers from levels of equal ratio. A stored 0 is a missing value.
function decode(code) {
  if (!code.values) code.values = "c" in code ? decodeDecimals(code) : decodeLevels(code);
  return code.values;
}
function decodeDecimals({ code, c }) {
  const word = (k) => code[k] * 256 + code[k + c];
  return Array.from({ length: c }, (_, k) => {
    const exponent = word(k + 2 * c);
    return exponent < 2 ? [null, 0][exponent] : Number(`${word(k)}e${exponent - 515}`);
  });
}
function decodeLevels({ code, w, s, d, l, h }) {
  const count = w ? code.length / 2 : code.length;
  const range = w ? 2 ** w : 256;
  const top = s ? range / 2 - 1 : range - 1;
  const step = Math.log(h / l) / (top - 1);
  const values = new Array(count);
  let level = 0;
  for (let k = 0; k < count; k++) {
    const raw = w ? code[k] * 256 + code[k + count] : code[k];
    level = d ? (level + raw) % range : raw;
    if (level === 0) values[k] = null;
    else if (!s) values[k] = l * Math.exp((level - 1) * step);
    else {
      const size = Math.abs(level - range / 2);
      values[k] = size === 0 ? 0 : Math.sign(level - range / 2) * l * Math.exp((size - 1) * step);
    }
  }
  return values;
}

// The view: the choice of the switches, kept in the address after #.
const budgetOf = () => data.budgets.find((budget) => budget.key === state.budget) || {};
function view() {
  const whole = viewOf(axes.map((axis) => state[axis]));
  const { filters } = budgetOf();
  return filters ? { ...whole, rows: whole.rows.filter((row) => filters.includes(row.filter)) } : whole;
}
const single = (cell) => viewOf([state.metric, cell.world, cell.regime, state.baseline]);

// A view from its columns (encoding.py): of its place, of all its baselines, and its own.
function viewOf(wish) {
  const key = viewKeys.findIndex((parts) => parts.every((part, k) => part === wish[k]));
  if (views.has(key)) return views.get(key);
  if (key < 0) return undefined;
  const { baselines, texts, fixed, shared, separate } = data.views;
  const [scope, base] = [Math.floor(key / baselines.length), key % baselines.length];
  const place = places.indexOf(placeOf(viewKeys[key]));
  const width = data.filters.length;
  const pick = (column, part, k) => ("c" in column ? decode(column)[part * width + k] : column[part][k]);
  const rows = data.filters.map((_, k) => {
    const row = { filter: pick(shared.filter, scope, k) };
    for (const [name, column] of Object.entries(fixed)) row[name] = pick(column, place, looks[row.filter].index);
    for (const [name, column] of Object.entries(shared)) row[name] = pick(column, scope, k);
    for (const [name, column] of Object.entries(separate)) row[name] = pick(column, key, k);
    return row;
  });
  const built = { ...texts[scope][base], rows, byFilter: Object.fromEntries(rows.map((row) => [row.filter, row])) };
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
