
"use strict";
(() => {
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const form = document.getElementById("filters");
  const selects = form ? all("select", form) : [];
  const columns = document.getElementById("columns");
  const tables = all("table.ranking");
  const state = new URLSearchParams();

  function remember() {
    try {
      const text = state.toString();
      history.replaceState(null, "", text ? "#" + text : location.pathname + location.search);
    } catch {
      // A frame without its own address: the view works, but it can't be linked to.
    }
  }

  // Sorting: as numbers where all rows have one, else as text; rows without a value come last in both directions.
  function sort(table, key, direction) {
    const heads = all("thead th", table);
    const column = heads.findIndex((head) => head.querySelector("button")?.dataset.key === key);
    if (column < 0) return false;
    const sign = direction === "descending" ? -1 : 1;
    const value = (row) => row.cells[column].dataset.v;
    const rows = all("tbody tr", table);
    const numeric = rows.every((row) => value(row) === undefined || !Number.isNaN(Number(value(row))));
    rows.map((row, index) => ({ row, index })).sort((a, b) => {
      const [first, second] = [value(a.row), value(b.row)];
      if (first === undefined || second === undefined) return (first === undefined) - (second === undefined);
      const order = numeric ? Number(first) - Number(second) : first.localeCompare(second, "en");
      return sign * order || a.index - b.index;
    }).forEach(({ row }) => table.tBodies[0].append(row));
    heads.forEach((head) => head.removeAttribute("aria-sort"));
    heads[column].setAttribute("aria-sort", direction);
    return true;
  }

  tables.forEach((table) => table.tHead.addEventListener("click", (event) => {
    const key = event.target.closest("button")?.dataset.key;
    if (!key) return;
    const current = event.target.closest("th").getAttribute("aria-sort");
    const direction = current === "ascending" ? "descending" : "ascending";
    sort(table, key, direction);
    state.set(table.id, key + "." + direction);
    remember();
  }));

  // Filters: the search field, a select for each name in a row's data, and boxes for the provenance.
  function filter() {
    const search = document.getElementById("q").value.trim().toLowerCase();
    const chosen = selects.filter((select) => select.value);
    const boxes = all("input[name=provenance]", form);
    const refused = boxes.filter((box) => !box.checked).map((box) => box.value);
    const shown = new Set();
    let count = 0;
    tables.forEach((table) => {
      const rows = all("tbody tr", table);
      rows.forEach((row) => {
        const data = row.dataset;
        row.hidden = !(data.search.includes(search) && !refused.includes(data.provenance)
          && chosen.every((select) => data[select.name] === select.value));
        if (!row.hidden) shown.add(row.id);
      });
      count += rows.length;
      table.closest(".board").hidden = rows.every((row) => row.hidden);
    });
    all("[data-row]").forEach((part) => { part.style.display = shown.has(part.dataset.row) ? "" : "none"; });
    all("[data-of]").forEach((row) => { row.hidden = !shown.has(row.dataset.of); });
    const message = shown.size === count ? "" : shown.size + " of " + count + " rows shown";
    document.getElementById("shown").textContent = message;
    const entries = { q: search, hide: refused.join(","), columns: columns.checked ? "all" : "" };
    for (const select of selects) entries[select.name] = select.value;
    for (const [key, value] of Object.entries(entries)) value ? state.set(key, value) : state.delete(key);
  }

  // On a phone, what has no column there is a list behind the row, and all columns are all lists.
  function showAll() {
    all("details.rest").forEach((rest) => { rest.open = columns.checked; });
  }
  all("details.rest").forEach((rest) => {
    rest.hidden = false;
    rest.addEventListener("toggle", () => {
      const heads = rest.closest("table").tHead.rows[0].cells;
      const parts = [...rest.closest("tr").cells].filter((cell) => cell.matches(".first, .more")).flatMap((cell) => {
        const [title, value] = ["dt", "dd"].map((name) => document.createElement(name));
        title.textContent = heads[cell.cellIndex].firstChild.textContent;
        value.append(...cell.cloneNode(true).childNodes);
        return [title, value];
      });
      rest.querySelector("dl").replaceChildren(...parts);
    });
  });

  function restore() {
    const hash = location.hash.slice(1);
    if (!hash.includes("=")) return;
    for (const [key, value] of new URLSearchParams(hash)) state.set(key, value);
    tables.forEach((table) => {
      const [key, direction] = (state.get(table.id) || "").split(".");
      if (!["ascending", "descending"].includes(direction) || !sort(table, key, direction)) state.delete(table.id);
    });
    if (!form) return;
    document.getElementById("q").value = (state.get("q") || "").slice(0, 100);
    for (const select of selects) {
      select.value = state.get(select.name) || "";
      if (select.selectedIndex < 0) select.value = "";
    }
    columns.checked = state.get("columns") === "all";
    showAll();
    const hidden = (state.get("hide") || "").split(",");
    all("input[name=provenance]", form).forEach((box) => { box.checked = !hidden.includes(box.value); });
    filter();
  }

  if (form) {
    const box = document.getElementById("filter-box");
    box.hidden = false;
    box.open = matchMedia("(min-width: 52rem)").matches || location.hash.includes("=");
    const changed = () => { filter(); remember(); };
    form.addEventListener("input", changed);
    columns.addEventListener("input", showAll);
    form.addEventListener("submit", (event) => event.preventDefault());
    form.addEventListener("reset", () => setTimeout(() => { showAll(); changed(); }));
  }

  // A number that is cut reads as another, so a cell shows nothing while the table's edge or its sticky columns cut it.
  function hideCut(box) {
    const heads = all("thead th", box);
    const stays = heads.map((head) => getComputedStyle(head).position === "sticky");
    const places = heads.map((head) => head.getBoundingClientRect());
    const frame = box.getBoundingClientRect();
    const left = Math.max(frame.left, ...places.filter((_, column) => stays[column]).map((place) => place.right));
    const cut = places.map((place, column) => !stays[column] && (place.left < left - 1 || place.right > frame.right + 1));
    all("tr", box).forEach((row) => [...row.cells].forEach((cell, column) => cell.classList.toggle("cut", cut[column])));
  }
  const resized = new ResizeObserver((changes) => changes.forEach(({ target }) => hideCut(target.closest(".scroll"))));
  for (const box of all(".scroll:has(thead)")) {
    box.addEventListener("scroll", () => hideCut(box));
    all("table", box).concat(box).forEach((part) => resized.observe(part));
  }

  // Highlight a row's mark under the mouse, and a mark's row.
  const near = (id, on) => {
    document.getElementById(id)?.classList.toggle("near", on);
    all(".point").filter((part) => part.dataset.row === id).forEach((part) => part.classList.toggle("near", on));
  };
  for (const [kind, on] of [["mouseover", true], ["mouseout", false]]) {
    document.addEventListener(kind, (event) => {
      const part = event.target.closest?.(".point, .ranking tbody tr");
      if (part) near(part.dataset.row || part.id, on);
    });
  }
  restore();
})();
