// Worlds as small multiples, calibration, and the table for a paper.
function drawWorlds(part) {
  const worlds = data.worlds.filter((world) => data.cells.some((cell) => cell.world === world.key && single(cell)));
  const regimes = data.regimes.map((regime) => regime.name).join(", ");
  find("#worldnote").textContent =
    `${metricOf().name} with its interval, in the order of the leaderboard.${data.regimes.length > 1 ? ` The marks of a row, from top to bottom: ${regimes}.` : ""} Arrows: outside of the figure.`;
  part.innerHTML = worlds.map(() => '<div class="panel"></div>').join("");
  findAll(".panel", part).forEach((panel, k) => drawWorld(panel, worlds[k]));
}
function drawWorld(panel, world) {
  const cells = data.cells.filter((cell) => cell.world === world.key && single(cell));
  const width = widthOf(panel);
  const step = cells.length > 1 ? 7 : 0;
  const filters = order();
  const title = wrap(world.name, width, 12, true);
  const [left, rowHeight] = nameColumn(filters, width, 11, Math.max(17, 6 + step * cells.length));
  const [right, top] = [10, 9 + 13 * title.length];
  const bottom = top + rowHeight * filters.length;
  const rows = cells.map((cell) => single(cell).byFilter);
  const sorted = (list) => list.filter((v) => v > 0).sort((a, b) => a - b);
  const all = rows.flatMap((row) => Object.values(row));
  const values = sorted(all.map((row) => row.value));
  const ends = sorted(all.flatMap((row) => [row.value, row.low, row.high]));
  let content = block(0, 8 + 6.5 * (title.length - 1), title, 12, "", true);
  if (!values.length)
    return void (panel.innerHTML = svg(
      width,
      top + 18,
      `${content}${label(0, top + 10, "No run has an error here.")}`,
      `${world.name}: no errors`,
    ));
  const low = ends[0] / 1.05;
  const high = Math.min(ends[ends.length - 1] * 1.05, Math.max(values[Math.floor(values.length / 2)] * 30, low * 1.5));
  const x = logarithmic(low, high, left, width - right);
  const inside = (v) => Math.min(width - right, Math.max(left, x(Math.max(v, 1e-12))));
  content += xAxis(logTicks(low, high, 5), x, top - 4, bottom);
  filters.forEach((look, k) => {
    const y = top + rowHeight * (k + 0.5);
    content += nameLabel(look, left - 8, y, left, 11, ' text-anchor="end"');
    rows.forEach((row, r) => {
      const item = row[look.key];
      const level = y + step * (r - (rows.length - 1) / 2);
      if (!item || item.value === null) return;
      const words = `${look.name}, ${cellName(cells[r])}: ${valueText(item)}`;
      const beyond = item.value > high;
      const whisker = item.low > 0 ? bar(inside(item.low), inside(item.high), level, 2, look, 0.45) : "";
      content += `<g${tip(words)}>${whisker}${beyond ? label(width - right, level + 4, "▸", ' text-anchor="end"') : mark(look, x(item.value), level, rows.length > 2 ? 2.8 : 3.6)}</g>`;
    });
  });
  const unit = (Object.values(rows[0])[0] || {}).unit || world.unit;
  content += label(
    (left + width - right) / 2,
    bottom + 30,
    `${metricOf().name} [${unit}] (log)`,
    ' class="axis" text-anchor="middle"',
  );
  panel.innerHTML = svg(
    width,
    bottom + 36,
    content,
    `${world.name}: ${metricOf().name} of ${filters.length} filters. Smallest: ${short(values[0])} ${unit}.`,
  );
}

function drawCalibration(part) {
  const shares = data.calibration[state.world]?.[state.regime] || {};
  const filters = order().filter((look) => shares[look.key]);
  const width = widthOf(part);
  const narrow = width < 640;
  if (!filters.length) return void (part.innerHTML = '<p class="note">This view has no intervals.</p>');
  const [left, rowHeight] = nameColumn(filters, width, 11.5, 21);
  const [right, top] = [narrow ? 12 : 240, 24];
  const bottom = top + rowHeight * filters.length;
  const x = linear(0, 1, left, width - right);
  let content = xAxis([0, 0.25, 0.5, 0.75, 0.9, 1], x, top, bottom, (v) => `${100 * v}`);
  for (const share of [0.5, 0.9])
    content +=
      line(x(share), top, x(share), bottom, ' class="rule"') +
      label(Math.min(x(share), width - textWidth("90 % interval", 11) / 2), top - 8, `${100 * share} % interval`, ' class="axis" text-anchor="middle"');
  content += label(
    (left + width - right) / 2,
    bottom + 30,
    "share of true values inside, %",
    ' class="axis" text-anchor="middle"',
  );
  const rows = view().byFilter;
  filters.forEach((look, k) => {
    const y = top + rowHeight * (k + 0.5);
    const { c50, c90, nees_ratio: nees } = shares[look.key];
    const word = rows[look.key].calibration ? `coverage ${rows[look.key].calibration}` : "";
    const words = `${look.name}: the 50 % intervals contain ${percent(c50)}, the 90 % intervals ${percent(c90)}; NEES per degree of freedom ${short(nees)}${word && `; ${word}`}`;
    content += nameLabel(look, left - 8, y, left, 11.5, ' text-anchor="end"');
    if (c50 === null || c90 === null) return;
    content += `<g${spoken(words)}>${bar(x(c50), x(c90), y, 2, look, 0.5)}<circle class="c${look.index}" cx="${px(x(c50))}" cy="${px(y)}" r="3.4" fill="var(--paper)" stroke="var(--c)" stroke-width="1.6"/>${mark(look, x(c90), y, 4.5)}</g>`;
    if (!narrow)
      content +=
        label(width - right + 14, y + 4, word, ' style="font-size:11.5px"') +
        label(width, y + 4, `NEES/dof ${short(nees)}`, ' class="axis" text-anchor="end"');
  });
  part.innerHTML = svg(
    width,
    bottom + 36,
    content,
    `Calibration of ${filters.length} filters: share of true values in their 50 and 90 % intervals.`,
    "group",
  );
}

function drawTable(part) {
  const cells = data.cells.filter(single);
  const rows = cells.map((cell) => single(cell).byFilter);
  const unit = (r) => (Object.values(rows[r]).find((row) => row.unit) || { unit: "" }).unit;
  const groups = data.worlds
    .map((world) => [world, cells.filter((cell) => cell.world === world.key)])
    .filter(([, list]) => list.length);
  let html = `<thead><tr><th scope="col" rowspan="2">Filter</th>${groups.map(([world, list]) => `<th scope="colgroup" colspan="${list.length}">${esc(world.name)}, ${esc(unit(cells.indexOf(list[0])))}</th>`).join("")}</tr>`;
  html += `<tr>${groups
    .flatMap(([, list]) => list)
    .map((cell) => `<th scope="col" class="number">${esc(named(data.regimes, cell.regime))}</th>`)
    .join("")}</tr></thead><tbody>`;
  const sequence = groups.flatMap(([, list]) => list).map((cell) => cells.indexOf(cell));
  for (const look of order()) {
    const bold = (row, r) =>
      short(row.value) === short(Math.min(...Object.values(rows[r]).map((item) => item.value ?? Infinity)));
    html += `<tr><th scope="row"${look.proposed ? ' class="proposed"' : ""}><span>${icon(look)}${esc(look.name)}</span></th>${sequence
      .map((r) => {
        const row = rows[r][look.key];
        if (!row || row.value === null) return `<td class="number faint">${row ? esc(row.words) : "–"}</td>`;
        const text = short(row.value);
        const shown = bold(row, r)
          ? `<b>${text}</b>`
          : row.verdict === "worse"
            ? `<span class="faint">${text}†</span>`
            : text;
        return `<td class="number">${shown}<br><span class="faint">${interval(row.low, row.high)}</span></td>`;
      })
      .join("")}</tr>`;
  }
  part.innerHTML = `${html}</tbody>`;
}
