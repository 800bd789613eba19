// Planned comparisons as a forest, and curves over a parameter.
const verdictStyle = (word) => ({ better: "good", worse: "bad", equal: "good", identical: "good" })[word.split(" ")[0]] || "open";

function drawForest(part) {
  const kinds = ["paper", "tuned", ""];
  const pairs = data.planned
    .filter((pair) => pair.estimate > 0)
    .sort((a, b) => kinds.indexOf(a.kind) - kinds.indexOf(b.kind));
  part.innerHTML = pairs.length ? forest(part, pairs) : "";
}

function forest(part, pairs) {
  const shown = (v) => v > 0 && v < Infinity;
  const width = widthOf(part);
  const narrow = width < 800;
  const wordsOf = (pair) => {
    const range = pair.low !== null && pair.high !== null ? `[${change(pair.low, pair.high)}, ${change(pair.high)}]` : "";
    return [change(pair.estimate, pair.high), range, pair.word].filter(Boolean).join(" ");
  };
  const widest = Math.max(...pairs.map((pair) => textWidth(wordsOf(pair), 11.5)));
  const [left, right] = narrow ? [8, 8] : [Math.min(310, width * 0.27), Math.ceil(widest) + 16];
  const ends = pairs
    .flatMap((pair) => [
      pair.low,
      pair.high,
      pair.estimate,
      ...pair.cells.map((cell) => cell.estimate),
      ...(pair.new_world ? [pair.new_world.low, pair.new_world.high] : []),
    ])
    .filter(shown);
  const low = Math.min(0.9, Math.max(1 / 30, Math.min(...ends))) / 1.05;
  const high = Math.max(1.1, Math.min(30, Math.max(...ends))) * 1.05;
  const x = logarithmic(low, high, left, width - right);
  const inside = (v) => Math.min(width - right, Math.max(left, x(Math.max(v, 1e-9))));
  let y = 18;
  let content = "";
  let question = null;
  for (const pair of pairs) {
    const kind = { tuned: "against tuned baselines", paper: "against the baselines of the paper" }[pair.kind];
    const group = kind ? `A${kind.slice(1)}` : "Pairs";
    if (group !== question) {
      const titles = wrap(group, width, 12, true);
      content += block(0, y + 8 + 6.5 * (titles.length - 1), titles, 12, "", true);
      y += 9 + 13 * titles.length;
      question = group;
    }
    const [a, b] = [looks[pair.a], looks[pair.b]];
    const names = `${a.name}${narrow ? " / " : " against "}${b.name}`;
    const known = pair.low !== null && pair.high !== null;
    const range = known ? `[${change(pair.low, pair.high)}, ${change(pair.high)}]` : pair.reason ? `(${pair.reason})` : "";
    const words = `${change(pair.estimate, pair.high)} ${range}`;
    const small = pair.cells.filter((cell) => shown(cell.estimate));
    const verdict = `${change(pair.estimate, pair.high)} ${pair.word}`;
    const size = narrow ? 11.5 : 12;
    const lines = wrap(names, narrow ? width - left - textWidth(verdict, 11.5) - 10 : left - 12, size);
    const rise = narrow ? 3.5 + 12.5 * lines.length : 0;
    const step = Math.min(5, 40 / Math.max(1, small.length));
    const height = Math.max(30, 20 + step * small.length, narrow ? 0 : 13 * lines.length + 6) + rise;
    const middle = y + rise + (narrow ? 11 : Math.max(11, 6.5 * lines.length + 2));
    if (narrow)
      content +=
        block(left, y + 8 + 6.25 * (lines.length - 1), lines, size) +
        label(
          width,
          y + 12,
          verdict,
          ` text-anchor="end" style="font-size:11.5px;fill:var(--${verdictStyle(pair.word)})"`,
        );
    else
      content +=
        block(left - 12, middle, lines, size, ' text-anchor="end"') +
        label(
          width - right + 12,
          middle + 4,
          wordsOf(pair),
          ` style="font-size:11.5px;fill:var(--${verdictStyle(pair.word)})"`,
        );
    content += `<g${spoken(`${group}. ${names}: ${words}, ${pair.words}.`)}><rect x="${left}" y="${px(y + rise)}" width="${px(width - left - right)}" height="${px(height - rise - 4)}" fill="transparent"/>`;
    if (pair.new_world && shown(pair.new_world.low) && shown(pair.new_world.high)) content += bar(inside(pair.new_world.low), inside(pair.new_world.high), middle, 3, a, 0.45);
    content +=
      (known ? bar(inside(pair.low), inside(pair.high), middle, 6, a, 0.85) : "") + mark(a, inside(pair.estimate), middle, 6) + "</g>";
    small.forEach((cell, k) => {
      const level = middle + 10 + step * (k + 0.5);
      const text = `${cell.name || cellName(cell)}: ${change(cell.estimate)} [${change(cell.low)}, ${change(cell.high)}]`;
      content += `<g${tip(text)}>${bar(inside(cell.low), inside(cell.high), level, 1.2, a, 0.7)}<circle class="c${a.index}" cx="${px(inside(cell.estimate))}" cy="${px(level)}" r="1.9" fill="var(--c)"/></g>`;
    });
    y += height;
  }
  const ticks = logTicks(low, high, narrow ? 5 : 9);
  const frame =
    xAxis(ticks, x, 10, y) +
    line(x(1), 10, x(1), y, ' class="rule"') +
    label(inside(low), y + 30, "← smaller error", ' class="axis"') +
    label(width - right, y + 30, "larger error →", ' class="axis" text-anchor="end"');
  return svg(
    width,
    y + 36,
    frame + content,
    `Planned comparisons: ${pairs.map((pair) => `${looks[pair.a].name} against ${looks[pair.b].name}: ${pair.word}`).join("; ")}.`,
    "group",
  );
}

function drawSweeps(part) {
  part.innerHTML = data.sweeps.map(() => '<div class="panel"></div>').join("");
  findAll(".panel", part).forEach((panel, k) => drawSweep(panel, data.sweeps[k]));
}
function drawSweep(panel, sweep) {
  const width = widthOf(panel);
  const title = wrap(`${named(data.worlds, sweep.world)}${sweep.regime ? `, ${named(data.regimes, sweep.regime)}` : ""}`, width, 12, true);
  const ends = sweep.lines.map((item) => ({ ...looks[item.filter], name: item.name }));
  const [right, gap] = nameColumn(ends, width, 11, 13);
  const [left, top, bottom] = [48, 11 + 13 * title.length, 38];
  const height = Math.max(260, top + bottom + gap * sweep.lines.length); // a name needs a line of its own
  const points = sweep.lines.flatMap((line) => line.points).filter((point) => point.value > 0);
  if (!points.length) return;
  const xs = points.map((point) => point.x);
  const logX = !sweep.ticks && Math.min(...xs) > 0 && Math.max(...xs) / Math.min(...xs) >= 20;
  const [xLow, xHigh] = [Math.min(...xs), Math.max(...xs)];
  const ys = points.flatMap((point) => [point.value, point.low, point.high]).filter((v) => v > 0);
  const [yLow, yHigh] = [Math.min(...ys) / 1.1, Math.max(...ys) * 1.1];
  const x = (logX ? logarithmic : linear)(xLow, xHigh === xLow ? xLow + 1 : xHigh, left + 6, width - right);
  const y = logarithmic(yLow, yHigh, height - bottom, top);
  const ticks = [...new Set(xs)].length <= 7 ? [...new Set(xs)] : (logX ? logTicks : linearTicks)(xLow, xHigh, 6);
  const format = sweep.ticks ? (v) => sweep.ticks[v] ?? "" : tidy;
  let content =
    xAxis(sweep.ticks ? sweep.ticks.map((_, k) => k) : ticks, x, top, height - bottom, format) + yAxis(logTicks(yLow, yHigh, 6), y, left, width - right);
  content += block(0, 8 + 6.5 * (title.length - 1), title, 12, "", true);
  content += label(
    (left + width - right) / 2,
    height - 6,
    `${sweep.name}${sweep.unit ? ` [${sweep.unit}]` : ""}${logX ? " (log)" : ""}`,
    ' class="axis" text-anchor="middle"',
  );
  const lines = sweep.lines
    .map((item) => [{ ...looks[item.filter], name: item.name }, item.points.filter((point) => point.value > 0)])
    .filter(([, values]) => values.length);
  const heights = spread(
    lines.map(([, values]) => y(values[values.length - 1].value)),
    gap,
    top,
    height - bottom,
  );
  lines.forEach(([look, values], k) => {
    const path = values.map((point, i) => `${i ? "L" : "M"}${px(x(point.x))} ${px(y(point.value))}`).join("");
    content += `<path class="c${look.index}" d="${path}" fill="none" stroke="var(--c)" stroke-width="1.6"${look.proposed ? "" : ' stroke-dasharray="5 3"'}/>`;
    for (const point of values) {
      if (point.low > 0)
        content += `<line class="c${look.index}" x1="${px(x(point.x))}" x2="${px(x(point.x))}" y1="${px(y(point.low))}" y2="${px(y(point.high))}" stroke="var(--c)" stroke-opacity=".5"/>`;
      content += `<g${spoken(`${look.name}, ${sweep.name} ${format(point.x)}: ${short(point.value)} ${sweep.value_unit || ""} ${interval(point.low, point.high)}`)}>${mark(look, x(point.x), y(point.value), 4)}</g>`;
    }
    content += nameLabel(look, width - right + 8, heights[k], right, 11);
  });
  panel.innerHTML = `${svg(width, height, content, sweep.caption || `${sweep.name} and error`, "group")}<p class="note">${esc(sweep.caption || "")}</p>`;
}
