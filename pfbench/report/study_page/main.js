// The first screen is drawn at once, each figure when it comes near, and after a switch only what is visible.
const figures = [
  ["#planned .figure", drawForest, false],
  ["#worlds .panels", drawWorlds, true],
  ["#time > .figure", drawTime, true],
  ["#calibration .figure", drawCalibration, true],
  ["#dots", drawRuns, true],
  ["#sweeps .panels", drawSweeps, false],
  ["#table table", drawTable, true],
]
  .map(([selector, draw, follows]) => ({ part: find(selector), draw, follows, stale: true, near: false }))
  .filter((figure) => figure.part);

function refresh(everything = false) {
  for (const figure of figures) {
    if (!figure.stale || !(figure.near || everything)) continue;
    figure.stale = false;
    figure.draw(figure.part);
  }
}
function drawView(changed = true) {
  drawSwitches();
  drawBoard();
  if (find("#cost")) drawCost(find("#cost .figure"));
  for (const select of findAll("select.cell")) {
    select.innerHTML = data.cells
      .filter(hasRuns)
      .map(
        (cell) =>
          `<option value="${data.cells.indexOf(cell)}"${cell === state.cell ? " selected" : ""}>${esc(cellName(cell))}</option>`,
      )
      .join("");
  }
  for (const figure of figures) figure.stale ||= changed && figure.follows;
  refresh();
  writeAddress();
}
function redraw(...draws) {
  for (const figure of figures) figure.stale ||= draws.includes(figure.draw);
  refresh();
}

const tipBox = find("#tip");
function showTip(words, x, y) {
  tipBox.textContent = words;
  tipBox.style.display = "block";
  tipBox.style.left = `${Math.max(4, Math.min(x + 14, innerWidth - tipBox.offsetWidth - 8))}px`;
  tipBox.style.top = `${y - tipBox.offsetHeight - 10 < 4 ? y + 18 : y - tipBox.offsetHeight - 10}px`;
}
const hideTip = () => (tipBox.style.display = "none");

function press(target) {
  const { sort, row, regime, budget, toggle: chip, dot, copy } = target.dataset;
  if (sort) {
    state.down = state.sort === sort ? !state.down : false;
    state.sort = sort;
    drawBoard();
    writeAddress();
    find(`[data-sort="${sort}"]`).focus();
  } else if (row !== undefined) {
    state.open = state.open === row ? null : row;
    drawBoard();
    findAll("[data-row]")
      .find((button) => button.dataset.row === row)
      .focus();
  } else if (regime) {
    choose("regime", regime);
    drawView();
    (findAll("[data-regime]").find((button) => button.dataset.regime === regime) || target).focus();
  } else if (budget) {
    chooseBudget(budget);
    drawView();
    find(`[data-budget="${budget}"]`).focus();
  } else if (chip) {
    toggle(chip);
    redraw(drawTime);
    if (dots) drawRun(false);
  } else if (dot) {
    const [k, run] = dot.split(" ").map(Number);
    state.filter = dots.filters[k].key;
    state.run = run;
    drawRun(true);
  } else if (copy) {
    const done = () => (target.textContent = "Copied");
    const text = document.getElementById(copy).innerText;
    if (navigator.clipboard) navigator.clipboard.writeText(text).then(done, () => selectText(copy));
    else selectText(copy);
  } else if (target.id === "theme") {
    const dark = document.documentElement.dataset.theme
      ? document.documentElement.dataset.theme === "dark"
      : matchMedia("(prefers-color-scheme: dark)").matches;
    document.documentElement.dataset.theme = dark ? "light" : "dark";
  }
}
function selectText(id) {
  getSelection().selectAllChildren(document.getElementById(id));
}

function listen() {
  document.addEventListener("click", (event) => {
    const target = event.target.closest(
      "[data-sort],[data-row],[data-regime],[data-budget],[data-toggle],[data-dot],[data-copy],#theme",
    );
    if (target) press(target);
  });
  document.addEventListener("change", (event) => {
    const axis = event.target.dataset.axis || event.target.id;
    if (axes.includes(axis)) {
      choose(axis, event.target.value);
      drawView();
    } else if (event.target.matches("select.cell")) {
      selectCell(data.cells[event.target.value]);
      for (const select of findAll("select.cell")) select.value = event.target.value;
      redraw(drawTime, drawRuns);
    }
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") hideTip();
    if (event.target.id !== "dot" || !event.key.startsWith("Arrow")) return;
    event.preventDefault();
    stepRun(event.key);
  });
  const told = (event) => event.target.closest && event.target.closest("[data-tip]");
  document.addEventListener("pointerover", (event) => {
    if (told(event)) showTip(told(event).dataset.tip, event.clientX, event.clientY);
    else if (!event.target.closest || !event.target.closest("svg")) hideTip();
  });
  document.addEventListener("focusin", (event) => {
    const part = told(event);
    if (!part || !part.matches(":focus-visible")) return hideTip();
    const box = part.getBoundingClientRect();
    showTip(part.dataset.tip, box.right, box.top);
  });
  addEventListener("hashchange", () => {
    followAddress();
    drawView();
  });
  let timer = null;
  let width = innerWidth;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    clearTimeout(timer);
    timer = setTimeout(() => {
      for (const figure of figures) figure.stale = true;
      drawView(false);
    }, 150);
  });
  addEventListener("beforeprint", () => {
    refresh(true);
    for (const part of findAll("details")) part.open = true;
  });
}

async function start() {
  document.documentElement.classList.add("script");
  await unpack();
  openView();
  if (innerWidth <= 640) for (const fold of findAll(".fold")) fold.open = false;
  listen();
  drawView();
  const watch = new IntersectionObserver(
    (entries) => {
      for (const entry of entries) figures.find((figure) => figure.part === entry.target).near = entry.isIntersecting;
      refresh();
    },
    { rootMargin: "400px" },
  );
  for (const figure of figures) watch.observe(figure.part);
  document.documentElement.dataset.ready = Math.round(performance.now());
}
start();
