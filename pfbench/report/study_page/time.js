// Error over time: medians of all runs, or one run. The names stand at the end of the lines.
function curveFigure(part, { t, lines, band = null, head, unit, height: least = 360, caption, isLog = true }) {
  const width = widthOf(part);
  const shown = lines.filter((item) => item.values.some((v) => v !== null && (!isLog || v > 0)));
  if (!shown.length) return void (part.innerHTML = '<p class="note">Select a filter.</p>');
  const narrow = width < 560;
  const hasNames = shown.length <= 40;
  const [right, gap] = hasNames ? nameColumn(shown.map((item) => item.look), width, 11, 12.5) : [20, 0];
  const [left, top, bottom] = [50, 22, 36];
  const height = Math.max(least, top + bottom + gap * shown.length);
  const usable = (v) => v !== null && v !== undefined && (!isLog || v > 0);
  const all = [...shown.flatMap((item) => item.values), ...(band ? [...band.low, ...band.high] : [])].filter(usable);
  let [low, high] = [Math.min(...all), Math.max(...all)];
  if (isLog) [low, high] = [low / 1.08, high * 1.08];
  else [low, high] = [Math.min(0, low), high * 1.05 || 1];
  const x = linear(t[0], t[t.length - 1] === t[0] ? t[0] + 1 : t[t.length - 1], left, width - right);
  const y = (isLog ? logarithmic : linear)(low, high, height - bottom, top);
  let content =
    xAxis(linearTicks(t[0], t[t.length - 1], narrow ? 4 : 8), x, top, height - bottom) +
    yAxis((isLog ? logTicks : linearTicks)(low, high, 7), y, left, width - right);
  content +=
    label(0, 12, `${head}${unit ? ` [${unit}]` : ""}${isLog ? " (log)" : ""}`, ' class="axis"') +
    label((left + width - right) / 2, height - 4, "time [s]", ' class="axis" text-anchor="middle"');
  const trace = (values) => {
    let path = "";
    let pen = "M";
    values.forEach((v, k) => {
      if (!usable(v)) return void (pen = "M");
      path += `${pen}${px(x(t[k]))} ${px(y(v))}`;
      pen = "L";
    });
    return path;
  };
  if (band) {
    const back = [...t.keys()]
      .reverse()
      .filter((k) => usable(band.low[k]))
      .map((k) => `L${px(x(t[k]))} ${px(y(band.low[k]))}`)
      .join("");
    content += `<path class="c${band.look.index}" d="${trace(band.high)}${back}Z" fill="var(--c)" fill-opacity=".14"/>`;
  }
  const last = shown.map((item) => [...item.values].reverse().find(usable));
  const heights = spread(last.map(y), gap, top, height - bottom);
  shown.forEach((item, k) => {
    const words = `${item.look.name}: at the end ${short(last[k], 2)} ${unit}`;
    const dash = item.look.proposed ? "" : ' stroke-dasharray="5 3"';
    content += `<path class="c${item.look.index}" d="${trace(item.values)}" fill="none" stroke="var(--c)" stroke-width="${item.bold ? 3 : 1.7}"${dash}${spoken(words)}/>`;
    const end = item.values.length - 1 - [...item.values].reverse().findIndex(usable);
    content += mark(item.look, x(t[end]), y(last[k]), 3.6);
    if (hasNames) content += nameLabel(item.look, width - right + 12, heights[k], right, 11);
  });
  content += `<line class="cross" y1="${top}" y2="${height - bottom}" stroke="var(--faint)" visibility="hidden"/>`;
  part.innerHTML = svg(
    width,
    height,
    content,
    `${caption}. At the end: ${shown
      .map((item, k) => `${item.look.name} ${short(last[k], 2)}`)
      .slice(0, 8)
      .join(", ")} ${unit}.`,
    "group",
  );
  part.firstChild.onpointermove = (event) => {
    const box = part.firstChild.getBoundingClientRect();
    const ratio = width / box.width;
    const time =
      t[0] + (((event.clientX - box.left) * ratio - left) / (width - right - left)) * (t[t.length - 1] - t[0]);
    const k = t.reduce((best, value, i) => (Math.abs(value - time) < Math.abs(t[best] - time) ? i : best), 0);
    const height = (event.clientY - box.top) * ratio;
    const near = shown
      .filter((item) => usable(item.values[k]))
      .reduce((a, b) => (!a || Math.abs(y(b.values[k]) - height) < Math.abs(y(a.values[k]) - height) ? b : a), null);
    const cross = find(".cross", part);
    cross.setAttribute("x1", x(t[k]));
    cross.setAttribute("x2", x(t[k]));
    cross.setAttribute("visibility", "visible");
    if (near)
      showTip(`${near.look.name}, ${tidy(t[k])} s: ${short(near.values[k], 2)} ${unit}`, event.clientX, event.clientY);
  };
  part.firstChild.onpointerleave = () => {
    find(".cross", part).setAttribute("visibility", "hidden");
    hideTip();
  };
}

function drawTime(part) {
  const cell = partOf(data.curves, state.cell);
  drawChips();
  if (!cell) return void (part.innerHTML = '<p class="note">This condition has no curves.</p>');
  const chosen = order().filter((look) => state.on.has(look.key) && cell.filters[look.key]);
  const steps = cell.t.length;
  const quantile = (look, k) => cell.filters[look.key][["median", "q10", "q90"][k]];
  const lines = chosen.map((look) => ({ look, values: quantile(look, 0) }));
  const best = chosen[0];
  const band = best && { look: best, low: quantile(best, 1), high: quantile(best, 2) };
  curveFigure(part, {
    t: cell.t,
    lines,
    band,
    head: `median ${cell.group} error`,
    unit: cell.unit,
    caption: `Median error over time of ${chosen.length} filters`,
    height: part.clientWidth < 560 ? 300 : 400,
  });
}
function drawChips() {
  const chip = (key, text, pressed) =>
    `<button type="button" data-toggle="${esc(key)}"${pressed === null ? "" : ` aria-pressed="${pressed}"`}>${text}</button>`;
  const focus = document.activeElement && document.activeElement.dataset.toggle;
  find("#time .chips").innerHTML =
    chip("*all", "all", null) +
    chip("*proposed", "proposed", null) +
    chip("*none", "none", null) +
    order()
      .map((look) => chip(look.key, icon(look) + esc(look.name), state.on.has(look.key)))
      .join("");
  find("#time summary").textContent = `Filters: ${state.on.size} of ${data.filters.length} in the figure`;
  if (focus)
    (findAll("#time .chips button").find((button) => button.dataset.toggle === focus) || { focus() {} }).focus();
}
function toggle(key) {
  if (key === "*all") state.on = new Set(data.filters.map((look) => look.key));
  else if (key === "*none") state.on = new Set();
  else if (key === "*proposed")
    state.on = new Set(data.filters.filter((look) => look.proposed).map((look) => look.key));
  else if (!state.on.delete(key)) state.on.add(key);
}
