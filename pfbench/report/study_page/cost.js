// The filters that no other beats in both ratio and cost, by cost.
function frontOf(rows) {
  let least = Infinity;
  const beaten = ({ ratio }) => ratio >= least || ((least = ratio), false);
  return [...rows].sort((a, b) => a.ms - b.ms || a.ratio - b.ratio).filter((row) => !beaten(row));
}

// Error ratio against the cost of a step, with the steps of the filters that no other beats in both.
function drawCost(part) {
  const rows = view().rows.filter((row) => row.ratio > 0 && row.ms > 0);
  part.closest("figure").hidden = rows.length < 2;
  if (rows.length < 2) return;
  const width = widthOf(part);
  const height = Math.min(520, Math.max(340, 0.95 * width));
  const axis = wrap(`error ÷ ${looks[state.baseline].name} (log) → worse`, height - 40, 11);
  const [left, right, top, bottom] = [34 + 12 * axis.length, 10, 14, 40];
  const ratios = rows.map((row) => row.ratio).sort((a, b) => a - b);
  const ends = rows.flatMap((row) => [row.ratio, row.ratio_low, row.ratio_high]).filter((v) => v > 0 && v < Infinity);
  const usual = ratios[Math.floor(0.9 * (ratios.length - 1))];
  const high = Math.max(1, Math.min(Math.max(...ends), Math.max(2.6, 1.6 * usual))) * 1.06;
  const low = Math.min(1, Math.max(Math.min(...ends), 0.5 * ratios[0])) / 1.06;
  const costs = rows.map((row) => row.ms);
  const x = logarithmic(Math.min(...costs) / 1.25, Math.max(...costs) * 1.35, left, width - right);
  const y = logarithmic(low, high, height - bottom, top);
  const inside = (v) => Math.min(height - bottom, Math.max(top, y(v)));
  const [xLow, xHigh] = [Math.min(...costs) / 1.25, Math.max(...costs) * 1.35];
  let content =
    xAxis(logTicks(xLow, xHigh, 6), x, top, height - bottom) + yAxis(logTicks(low, high, 8), y, left, width - right);
  content += line(left, y(1), width - right, y(1), ' class="rule"');
  content += label(
    (left + width - right) / 2,
    height - 6,
    "ms per step (log) → dearer",
    ' class="axis" text-anchor="middle"',
  );
  content += axis
    .map(
      (text, k) =>
        `<text class="axis" transform="translate(${11 + 12 * k} ${height / 2}) rotate(-90)" text-anchor="middle">${esc(text)}</text>`,
    )
    .join("");
  const front = frontOf(rows);
  const path = front
    .map((row, k) => (k ? `H${px(x(row.ms))}V${px(inside(row.ratio))}` : `M${px(x(row.ms))} ${px(inside(row.ratio))}`))
    .join("");
  content += `<path d="${path}H${px(width - right)}" fill="none" stroke="var(--faint)" stroke-dasharray="1.5 3"/>`;
  const boxes = rows.map((row) => [x(row.ms) - 6, inside(row.ratio) - 6, x(row.ms) + 6, inside(row.ratio) + 6]);
  boxes.push([left, y(1) - 1, width - right, y(1) + 1]); // the line of the baseline
  for (const row of rows) {
    const look = looks[row.filter];
    if (row.ratio_low > 0)
      content += `<line class="c${look.index}" x1="${px(x(row.ms))}" x2="${px(x(row.ms))}" y1="${px(inside(row.ratio_low))}" y2="${px(inside(row.ratio_high))}" stroke="var(--c)" stroke-opacity=".4" stroke-width="2"/>`;
  }
  for (const row of rows) {
    const words = `${looks[row.filter].name}: ratio ${short(row.ratio)} ${interval(row.ratio_low, row.ratio_high)}, ${short(row.ms)} ms per step`;
    content += `<g${spoken(words)}>${mark(looks[row.filter], x(row.ms), inside(row.ratio), 5)}</g>`;
  }
  const important = (row) =>
    looks[row.filter].proposed ? 0 : front.includes(row) || row.filter === state.baseline ? 1 : 2;
  for (const row of [...rows].sort((a, b) => important(a) - important(b)))
    content += nameBeside(row, x(row.ms), inside(row.ratio), y(row.ratio), boxes, [left, top, width, height - bottom]);
  const first = looks[view().rows[0].filter].name;
  part.innerHTML = svg(
    width,
    height,
    content,
    `Error ratio against milliseconds per step of ${rows.length} filters. The smallest error has ${first}.`,
    "group",
  );
}

// The name where it covers nothing, or not at all: the tooltip has it too.
function nameBeside(row, x, y, wanted, boxes, [left, top, right, bottom]) {
  const look = looks[row.filter];
  const text = look.name + (Math.abs(y - wanted) > 1 ? ` ${short(row.ratio)} ${wanted < y ? "↑" : "↓"}` : "");
  const length = textWidth(text, 11, look.proposed);
  const places = [
    [8, 4, 0],
    [-8 - length, 4, 0],
    [-length / 2, -9, 0],
    [-length / 2, 18, 0],
    [7, -7, 0],
    [7, 15, 0],
    [-7 - length, -7, 0],
    [-7 - length, 15, 0],
    [6 - length, 18, 0],
    [6 - length, -9, 0],
    [6 - length, 29, 0],
  ];
  for (const [dx, dy] of places) {
    const box = [x + dx, y + dy - 10, x + dx + length, y + dy + 2];
    if (box[0] < left || box[2] > right || box[1] < top - 12 || box[3] > bottom) continue;
    if (boxes.some((b) => box[0] < b[2] && b[0] < box[2] && box[1] < b[3] && b[1] < box[3])) continue;
    boxes.push(box);
    return label(x + dx, y + dy, text, ` style="font-size:11px"${look.proposed ? ' class="strong"' : ""}`);
  }
  return "";
}
