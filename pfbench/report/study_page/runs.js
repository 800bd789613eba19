// Single runs: a dot for each run; the chosen one with its track, its errors and its traces.
let dots = null; // geometry of the dots that are drawn: condition, filters, scale

const runsOf = () => partOf(data.runs, state.cell);
const runValues = (key) => runsOf().values[key];
const runFilters = () => order().filter((look) => runsOf()?.values[look.key]);
const byError = (key) =>
  runValues(key)
    .map((v, k) => [v === null ? Infinity : v, k])
    .sort((a, b) => a[0] - b[0] || a[1] - b[1])
    .map(([, k]) => k);

function drawRuns(part) {
  const cell = runsOf();
  const filters = runFilters();
  if (!cell || !filters.length) {
    part.innerHTML = '<p class="note">This condition has no runs.</p>';
    for (const id of ["#plane", "#planenote", "#runtimes", "#runwords"]) find(id).innerHTML = "";
    return;
  }
  const width = widthOf(part);
  const [left, rowHeight] = nameColumn(filters, width, 11.5, 19);
  const [right, top] = [46, 8];
  const bottom = top + rowHeight * filters.length;
  const values = filters
    .flatMap((look) => runValues(look.key))
    .filter((v) => v > 0)
    .sort((a, b) => a - b);
  const low = (values[0] || 1) / 1.15;
  const high = Math.max(
    Math.min((values[values.length - 1] || 1) * 1.2, (values[Math.floor(values.length / 2)] || 1) * 200),
    low * 1.5,
  );
  const x = logarithmic(low, high, left, width - right);
  const place = (v) =>
    v === null ? width - right + 24 : Math.min(width - right, Math.max(left, x(Math.max(v, 1e-12))));
  const level = (k) => top + rowHeight * (k + 0.5);
  let content =
    xAxis(logTicks(low, high, 7), x, top, bottom) +
    label(
      (left + width - right) / 2,
      bottom + 30,
      `${cell.name || "error"} of a run [${cell.unit}] (log)`,
      ' class="axis" text-anchor="middle"',
    );
  if (filters.some((look) => runValues(look.key).includes(null)))
    content += label(width - right + 24, bottom + 14, "lost", ' class="axis" text-anchor="middle"');
  filters.forEach((look, k) => {
    content += nameLabel(look, left - 8, level(k), left, 11.5, ' text-anchor="end"');
    const circles = runValues(look.key)
      .map((v, j) => `<circle cx="${px(place(v))}" cy="${px(level(k))}" r="3.4" data-dot="${k} ${j}"/>`)
      .join("");
    content += `<g class="c${look.index}" fill="var(--c)" fill-opacity=".3">${circles}</g>`;
  });
  part.innerHTML = svg(
    width,
    bottom + 36,
    `${content}<g id="chosen"></g>`,
    `All runs of ${filters.length} filters in ${cellName(state.cell)}.`,
    "group",
  );
  dots = { filters, place, level };
  if (state.run === null || !filters.some((look) => look.key === state.filter)) {
    const best = byError(filters[0].key);
    state.filter = filters[0].key;
    state.run = best[Math.floor(best.length / 2)];
    const carried = (partOf(data.tracks, state.cell) || { numbers: [] }).numbers.map((number) => cell.numbers.indexOf(number));
    if (carried.length && !carried.includes(state.run)) state.run = carried[0];
  }
  drawRun(false);
}

function drawRun(focus) {
  const cell = runsOf();
  const look = looks[state.filter];
  const value = runValues(state.filter)[state.run];
  const number = cell.numbers[state.run];
  const error = (key) => runValues(key)[state.run];
  const path = dots.filters
    .map((item, k) => `${k ? "L" : "M"}${px(dots.place(error(item.key)))} ${px(dots.level(k))}`)
    .join("");
  const row = dots.filters.indexOf(look);
  const text = value === null ? "lost" : `${short(value, 2)} ${cell.unit}`;
  const words = `${look.name}, run ${number}: ${text}`;
  find("#chosen").innerHTML =
    `<path d="${path}" fill="none" stroke="var(--ink)" stroke-opacity=".4" pointer-events="none"/>` +
    `<circle class="c${look.index}" id="dot" cx="${px(dots.place(value))}" cy="${px(dots.level(row))}" r="6" fill="var(--c)" stroke="var(--ink)" stroke-width="1.5" tabindex="0" role="button" aria-label="${esc(words)}"${tip(words)}/>`;
  if (focus) find("#dot").focus();
  const place = state.cell;
  const rank =
    1 + dots.filters.filter((item) => error(item.key) !== null && (value === null || error(item.key) < value)).length;
  const fill = { world: place.world, noise: place.noise, filter: look.key, run: number, model: place.model };
  const command = data.replay
    ? quoted(data.replay.replace(/\{(\w+)\}/g, (all, name) => (name in fill ? fill[name] : all)))
    : "";
  const first = data.replay_first
    ? `. The page was made without the results, which the command needs. They are made by <code>${esc(data.replay_first)}</code>.`
    : "";
  find("#runwords").innerHTML =
    `Run ${esc(number)} of ${esc(cellName(place))}: ${icon(look)}<b>${esc(look.name)}</b> ${esc(text)}, rank ${rank} of ${dots.filters.length} in this run.${command ? ` Repeat it: <code>${esc(command)}</code>${first}` : ""}`;
  drawTrack(look, number, cell);
}

// Words of a command with signs of the shell in single quotes.
const quoted = (command) =>
  command
    .split(" ")
    .map((word) => (/[^\w.,=/+-]/.test(word) ? `'${word}'` : word))
    .join(" ");

function drawTrack(look, number, cell) {
  const part = partOf(data.tracks, state.cell);
  const carried = part && part.numbers.includes(number) && part.error[look.key] && part.error[look.key][number];
  const few =
    part && part.numbers.length < cell.numbers.length
      ? ` The page carries tracks of ${part.numbers.length} of ${cell.numbers.length} runs of this condition: ${[...part.numbers].sort((a, b) => a - b).join(", ")}.`
      : "";
  find("#plane").innerHTML = "";
  find("#runtimes").innerHTML = "";
  find("#planenote").textContent = carried
    ? `${part.note || ""}${few}`
    : part
      ? `No track of this run is in the page.${few} The command shows it.`
      : "No tracks are in the page. The command shows them.";
  if (!carried) return;
  const truth = part.truth && (part.truth[number] || part.truth.all);
  if (truth && part.plane[look.key]) drawPlane(find("#plane"), look, truth, part.plane[look.key][number]);
  const times = [];
  const add = (filters, head, unit, isLog, t = part.t) => {
    const lines = order()
      .filter((item) => (item === look || state.on.has(item.key)) && filters[item.key] && filters[item.key][number])
      .map((item) => ({ look: item, values: filters[item.key][number], bold: item === look }))
      .filter((item) => item.values.some((v) => v > 0 || (!isLog && v !== null)));
    if (lines.length)
      times.push({ t, lines, head, unit, isLog, height: 210, caption: `${head} of run ${number} over time` });
  };
  add(part.error, "error of the run", part.unit, true);
  for (const trace of part.traces) add(trace.filters, trace.name, trace.unit, trace.log !== false, trace.t);
  find("#runtimes").innerHTML = times.map(() => '<div class="figure"></div>').join("");
  findAll("#runtimes .figure").forEach((figure, k) => curveFigure(figure, times[k]));
}

function drawPlane(part, look, points, flat) {
  const truth = points.filter((point) => point !== null);
  const usable = points
    .map((point, k) => [[flat[2 * k], flat[2 * k + 1]], point])
    .filter(([error, point]) => point !== null && error[0] !== null && error[1] !== null);
  if (!usable.length) return;
  const extent = (points, axis) => Math.max(...points.map((p) => p[axis])) - Math.min(...points.map((p) => p[axis]));
  const span = Math.max(extent(truth, 0), extent(truth, 1));
  const sizes = usable.map(([error]) => Math.hypot(...error)).sort((a, b) => a - b);
  const middle = sizes[Math.floor(sizes.length / 2)];
  let factor = 1;
  if (span > 0 && middle > 0) while (factor * middle < 0.015 * span) factor *= 10;
  const track = usable.map(([error, point]) => [point[0] + factor * error[0], point[1] + factor * error[1]]);
  const width = widthOf(part);
  const height = Math.min(380, 0.75 * width);
  const [left, right, top, bottom] = [52, 12, 10, 36];
  const both = [...truth, ...track];
  const mid = (axis) => (Math.max(...both.map((p) => p[axis])) + Math.min(...both.map((p) => p[axis]))) / 2;
  const scale =
    Math.max(extent(both, 0) / (width - left - right), extent(both, 1) / (height - top - bottom)) * 1.1 || 1;
  const [cx, cy] = [mid(0), mid(1)];
  const x = (v) => (left + width - right) / 2 + (v - cx) / scale;
  const y = (v) => (top + height - bottom) / 2 - (v - cy) / scale;
  const half = [((width - left - right) / 2) * scale, ((height - top - bottom) / 2) * scale];
  const inKm = Math.max(...half) > 3000;
  const format = (v) => tidy(v / (inKm ? 1000 : 1));
  let content =
    xAxis(linearTicks(cx - half[0], cx + half[0], 5), x, top, height - bottom, format) +
    yAxis(linearTicks(cy - half[1], cy + half[1], 5), y, left, width - right, format);
  const path = (list) => `M${list.map((p) => `${px(x(p[0]))} ${px(y(p[1]))}`).join("L")}`;
  const unit = inKm ? "km" : "m";
  track.forEach((p, k) => {
    if (k % 3 === 0)
      content += `<line class="c${look.index}" x1="${px(x(usable[k][1][0]))}" y1="${px(y(usable[k][1][1]))}" x2="${px(x(p[0]))}" y2="${px(y(p[1]))}" stroke="var(--c)" stroke-opacity=".3"/>`;
  });
  content += `<path d="${path(truth)}" fill="none" stroke="var(--ink)" stroke-width="2.4"/><path class="c${look.index}" d="${path(track)}" fill="none" stroke="var(--c)" stroke-width="1.8" stroke-dasharray="7 2"/>`;
  content +=
    mark(look, x(track[track.length - 1][0]), y(track[track.length - 1][1]), 5.5) +
    label((left + width - right) / 2, height - 4, `East [${unit}]`, ' class="axis" text-anchor="middle"');
  content += `<text class="axis" transform="translate(11 ${px((top + height - bottom) / 2)}) rotate(-90)" text-anchor="middle">North [${unit}]</text>`;
  part.innerHTML = svg(width, height, content, `Track of ${look.name} on the plane with the true track.`);
  find("#planenote").textContent =
    `Plain line: truth. Dashed line: ${look.name}, with its mark at the end.${factor > 1 ? ` The errors are drawn ${factor} times as large.` : ""} ${find("#planenote").textContent}`;
}

// Arrow keys: left and right along the runs of a filter, up and down between filters.
function stepRun(key) {
  if (key === "ArrowLeft" || key === "ArrowRight") {
    const sequence = byError(state.filter);
    const next = sequence[sequence.indexOf(state.run) + (key === "ArrowRight" ? 1 : -1)];
    if (next !== undefined) state.run = next;
  } else {
    const k = dots.filters.indexOf(looks[state.filter]) + (key === "ArrowDown" ? 1 : -1);
    if (dots.filters[k]) state.filter = dots.filters[k].key;
  }
  drawRun(true);
}
