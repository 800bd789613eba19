// Sentence, switches and leaderboard.
const signs = { better: "▲", equal: "≈", "equal in kept runs": "≈", identical: "≈", "not decided": "?", worse: "▼", "loses track": "✕", missing: "–" };
const few = new Set(["rank", "filter", "ratio", "verdict", "track"]); // columns of a telephone
const numeric = new Set(["rank", "ratio", "track", "ms"]);
const isTimed = () => view().rows.some((row) => row.ms !== null);

function heads() {
  const baseline = looks[state.baseline].name;
  const several = cellsInView().length > 1;
  const all = [
    { key: "rank", text: "#", value: (row) => row.rank },
    { key: "filter", text: "Filter", value: (row) => looks[row.filter].name.toLowerCase() },
    {
      key: "value",
      text: several ? "Where" : "Error",
      small: several ? "darker: worse" : "median",
      value: (row) => row.value,
    },
    {
      key: "ratio",
      text: `÷ ${baseline}`,
      small: "with interval",
      value: (row) => row.ratio,
    },
    { key: "bar", text: "Ratio", small: "log scale" },
    { key: "verdict", text: "Verdict", small: "jointly", value: (row) => row.rank },
    { key: "track", text: "Track kept", value: (row) => row.track },
    { key: "calibration", text: "Coverage", small: "90 % intervals", value: (row) => row.coverage },
    ...(isTimed() ? [{ key: "ms", text: "ms/step", value: (row) => row.ms }] : []),
  ];
  return all.map((head) => ({
    ...head,
    style: `${numeric.has(head.key) ? "number" : ""}${few.has(head.key) ? "" : " desk"}`,
  }));
}

function drawSwitches() {
  const known = (axis, value) => viewKeys.some((key) => key[axes.indexOf(axis)] === value);
  const option =
    (axis) =>
    ([value, text]) =>
      `<option value="${esc(value)}"${state[axis] === value ? " selected" : ""}${known(axis, value) ? "" : " disabled"}>${esc(text)}</option>`;
  const items = (list, all) => [
    ...(known(all, "all") && list.length > 1 ? [["all", all === "world" ? `All ${list.length} scenarios` : "All"]] : []),
    ...list.map((item) => [item.key, item.name]),
  ];
  find("#metric").innerHTML = items(data.metrics).map(option("metric")).join("");
  find("#world").innerHTML = items(data.worlds, "world").map(option("world")).join("");
  find("#baseline").innerHTML = data.baselines.map((key) => option("baseline")([key, looks[key].name])).join("");
  const regimes = items(data.regimes, "regime");
  find("#regime").hidden = regimes.length < 2;
  find("#regime").innerHTML =
    regimes.length > 5
      ? `<select aria-label="Noise regime" data-axis="regime">${regimes.map(option("regime")).join("")}</select>`
      : regimes
          .map(
            ([value, text]) =>
              `<button type="button" data-regime="${esc(value)}" aria-pressed="${state.regime === value}"${known("regime", value) ? "" : " disabled"}>${esc(text)}</button>`,
          )
          .join("");
  find("#budget").hidden = data.budgets.length < 2;
  find("#budget").innerHTML = data.budgets
    .map(
      (budget) =>
        `<button type="button" data-budget="${esc(budget.key)}" aria-pressed="${budget.key === state.budget}"${budget.reason_missing ? ` disabled title="${esc(budget.reason_missing)}"` : ""}>${esc(budget.name)}</button>`,
    )
    .join("");
}

function strip(filter) {
  const cells = cellsInView();
  const size = cells.length > 9 ? ` style="--w:${Math.max(4, Math.floor(130 / cells.length))}px;--gap:1px"` : "";
  return `<span class="strip"${size}>${cells
    .map((cell) => {
      const { rows, byFilter } = single(cell) || { rows: [], byFilter: {} };
      const best = rows.find((row) => row.value !== null);
      const row = byFilter[filter];
      if (!row || row.value === null || !best)
        return `<i class="none" title="${esc(`${cellName(cell)}: ${row ? row.words : "not run"}`)}"></i>`;
      const gap = Math.abs(Math.log(row.value / best.value));
      const words = `${cellName(cell)}: ${short(row.value)} ${row.unit || ""} ${interval(row.low, row.high)}`;
      return `<i style="--d:${Math.min(1, 0.06 + gap / 2.5).toFixed(2)}" title="${esc(words)}"></i>`;
    })
    .join("")}</span>`;
}
const valueText = (row) =>
  row.value === null ? "–" : `${short(row.value)} ${row.unit || ""} ${interval(row.low, row.high)}`;

function ratioBars(rows) {
  const ends = rows.flatMap((row) => [row.ratio, row.ratio_low, row.ratio_high]).filter((v) => v > 0 && v < Infinity);
  const low = Math.max(Math.min(0.9, ...ends), 0.05) / 1.05;
  const high = Math.min(Math.max(1.1, ...ends), 20) * 1.05;
  const x = logarithmic(low, high, 6, 112);
  const inside = (v) => Math.min(high, Math.max(low, v));
  return (row) => {
    if (row.ratio === null) return "";
    const look = looks[row.filter];
    const whisker =
      row.ratio_low > 0 && row.ratio_high > 0 ? bar(x(inside(row.ratio_low)), x(inside(row.ratio_high)), 11, 3, look, 0.45) : "";
    const edge =
      row.ratio > high
        ? label(112, 15, "▸", ' text-anchor="end"')
        : row.ratio < low
          ? label(0, 15, "◂")
          : mark(look, x(row.ratio), 11, 4.2);
    return `<svg viewBox="0 0 118 22" width="118" height="22" aria-hidden="true">${line(x(1), 0, x(1), 22, ' class="rule"')}${whisker}${edge}</svg>`;
  };
}

// Quartiles of the rounds, where the filters were timed in turn.
function quartiles(row) {
  return row.ms_low > 0 ? interval(row.ms_low, row.ms_high) : "";
}

function details(row, span) {
  const look = looks[row.filter];
  const items = [
    ["Name", look.long || look.name],
    ["Key", look.key],
    ["Family", look.family],
    [metricOf().name, valueText(row)],
    [`Ratio to ${looks[state.baseline].name}`, `${short(row.ratio, 4)} ${interval(row.ratio_low, row.ratio_high)}`],
    [`Against ${looks[state.baseline].name}`, row.p === null ? row.words : `${row.words}; p = ${short(row.p)} for all filters together`],
    ["Track kept", percent(row.track)],
    ["Lost runs", row.lost === null ? "–" : row.lost],
    ["Coverage of 90 % intervals", percent(row.coverage)],
    ["NEES per degree of freedom", short(row.nees)],
    ...(row.ms === null ? [] : [["ms per step", `${short(row.ms)} ${quartiles(row)}`]]),
    ...(row.cost > 0 ? [[`ms per step ÷ ${looks[state.baseline].name}`, `${short(row.cost)} ${interval(row.cost_low, row.cost_high)}`]] : []),
  ];
  if (cellsInView().length > 1) {
    for (const cell of cellsInView()) {
      const own = single(cell) && single(cell).byFilter[row.filter];
      items.push([cellName(cell), own ? valueText(own) : "–"]);
    }
  }
  return `<tr><td class="all" colspan="${span}"><dl>${items.map(([head, text]) => `<div><dt>${esc(head)}</dt><dd>${esc(text)}</dd></div>`).join("")}</dl></td></tr>`;
}

function sortedRows() {
  const head = heads().find((item) => item.key === state.sort) || heads()[0];
  const sign = state.down ? -1 : 1;
  return view()
    .rows.map((row, k) => [row, k])
    .sort(([a, i], [b, j]) => {
      const [x, y] = [head.value(a), head.value(b)];
      if (x === null || y === null) return (x === null) - (y === null) || i - j;
      return (typeof x === "string" ? x.localeCompare(y) * sign : (x - y) * sign) || i - j;
    })
    .map(([row]) => row);
}

function drawBoard() {
  const shown = view();
  const several = cellsInView().length > 1;
  Object.assign(find("#answer"), { innerHTML: strong(shown.sentence), hidden: !!find("p.answer:not(#answer)") && state.world === data.opening[1] });
  find("#small").textContent = shown.small_print;
  const scope = (axis, items, noun) =>
    state[axis] !== "all"
      ? named(items, state[axis])
      : items.length > 4
        ? `all ${items.length} ${noun}s`
        : items.map((item) => item.name).join(", ") + (items.length > 1 ? " together" : "");
  find("#caption").textContent =
    `${metricOf().name}; ${scope("world", data.worlds, "scenario")}; ${scope("regime", data.regimes, "noise regime")}; ratio to ${looks[state.baseline].name}${budgetOf().words ? `; ${budgetOf().words}` : ""}.`;
  const columns = heads();
  find("#heads").innerHTML = columns
    .map((head) => {
      const sort = head.key === state.sort ? ` aria-sort="${state.down ? "descending" : "ascending"}"` : "";
      const text = head.value
        ? `<button type="button" data-sort="${head.key}">${esc(head.text)}</button>`
        : esc(head.text);
      return `<th scope="col" class="${head.style}"${sort}>${text}${head.small ? `<small>${esc(head.small)}</small>` : ""}</th>`;
    })
    .join("");
  const drawBar = ratioBars(shown.rows);
  find("#rows").innerHTML = sortedRows()
    .map((row) => {
      const look = looks[row.filter];
      const open = state.open === row.filter;
      return (
        `<tr data-filter="${esc(row.filter)}"><td class="number">${row.rank === null ? "–" : row.rank}</td>` +
        `<th scope="row"${look.proposed ? ' class="proposed"' : ""}><button type="button" class="name" data-row="${esc(row.filter)}" aria-expanded="${open}" title="${esc(look.long || look.name)}">${icon(look)}${esc(look.name)}</button></th>` +
        `<td class="desk">${several ? strip(row.filter) : esc(valueText(row))}</td>` +
        `<td class="number"><b>${end(row.ratio)}</b> <span class="interval faint">${interval(row.ratio_low, row.ratio_high)}</span></td>` +
        `<td class="desk scale">${drawBar(row)}</td><td class="verdict ${row.verdict.replaceAll(" ", "_")}">${signs[row.verdict] || ""} ${esc(row.words)}</td>` +
        `<td class="number">${percent(row.track)}</td><td class="desk">${percent(row.coverage)}${row.calibration ? ", " : ""}<span class="not_decided">${esc(row.calibration || "")}</span></td>` +
        (isTimed() ? `<td class="number desk"${row.cost > 0 ? ` title="ratio ${short(row.cost)} ${interval(row.cost_low, row.cost_high)}"` : ""}>${short(row.ms)}${row.ms_low > 0 ? ` <span class="interval faint">${quartiles(row)}</span>` : ""}</td>` : "") + `</tr>${open ? details(row, columns.length) : ""}`
      );
    })
    .join("");
}
