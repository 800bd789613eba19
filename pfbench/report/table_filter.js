// Filter and sort the table of all comparisons. Without scripts the table shows all rows.
"use strict";
(() => {
  const box = document.querySelector(".sift");
  if (!box) return;
  const table = box.querySelector("table"), body = table.tBodies[0], rows = [...body.rows];
  const heads = [...table.tHead.rows[0].cells], text = (row, k) => row.cells[k].textContent;
  const bar = document.createElement("p"), count = document.createElement("output");
  bar.className = "bar";
  const add = (label, part) => {
    const field = document.createElement("label");
    field.append(label + " ", part);
    bar.append(field);
    part.addEventListener("input", sift);
    return part;
  };
  const choice = (name) => {
    const k = heads.findIndex((head) => head.textContent === name), part = document.createElement("select");
    for (const value of ["all", ...new Set(rows.map((row) => text(row, k)))]) part.append(new Option(value));
    return [k, add(name, part)];
  };
  const choices = [choice("condition"), choice("group"), choice("decision")];
  const words = add("search", Object.assign(document.createElement("input"), { type: "search", placeholder: "all words must match" }));
  function sift() {
    const terms = words.value.toLowerCase().split(/\s+/);
    let n = 0;
    for (const row of rows) {
      const line = row.textContent.toLowerCase();
      const matches = terms.every((word) => line.includes(word)) &&
        choices.every(([k, part]) => part.selectedIndex === 0 || text(row, k) === part.value);
      row.hidden = !matches;
      n += matches;
    }
    count.textContent = n + " of " + rows.length + " shown";
  }
  const value = (row, k) => {
    const shown = text(row, k).replace("\u2212", "-").replace("\u221e", "Infinity");
    return shown === "\u2013" ? NaN : Number(shown);
  };
  heads.forEach((head, k) => {
    let up = true;
    head.tabIndex = 0;
    head.title = "sort";
    const sort = () => {
      const numeric = head.classList.contains("number"), sign = up ? 1 : -1;
      up = !up;
      rows.sort((a, b) => {
        if (!numeric) return sign * text(a, k).localeCompare(text(b, k));
        const x = value(a, k), y = value(b, k);
        return Number.isNaN(x) - Number.isNaN(y) || (x === y ? 0 : sign * (x < y ? -1 : 1)) || 0;
      });
      body.append(...rows);
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    };
    head.addEventListener("click", sort);
    head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(); });
  });
  bar.append(count);
  box.prepend(bar);
  sift();
})();
