
"use strict";
(() => {
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const form = document.getElementById("filters");
  const tables = all("table.ranking");
  const state = new URLSearchParams();

  function remember() {
    try {
      const text = state.toString();
      history.replaceState(null, "", text ? "#" + text : location.pathname + location.search);
    } catch {
      // A frame without an address of its own: the view works, it just can't be linked to.
    }
  }

  // Sorting: a number where both have one, else text; what has no value comes last in either direction.
  function sort(table, key, direction) {
    const heads = all("thead th", table);
    const place = heads.findIndex((head) => head.querySelector("button")?.dataset.key === key);
    if (place < 0) return false;
    const sign = direction === "descending" ? -1 : 1;
    const value = (row) => row.cells[place].dataset.v;
    const rows = all("tbody tr", table);
    const numeric = rows.every((row) => value(row) === undefined || !Number.isNaN(Number(value(row))));
    rows.map((row, index) => ({ row, index })).sort((a, b) => {
      const [one, other] = [value(a.row), value(b.row)];
      if (one === undefined || other === undefined) return (one === undefined) - (other === undefined);
      const order = numeric ? Number(one) - Number(other) : one.localeCompare(other, "en");
      return sign * order || a.index - b.index;
    }).forEach(({ row }) => table.tBodies[0].append(row));
    heads.forEach((head) => head.removeAttribute("aria-sort"));
    heads[place].setAttribute("aria-sort", direction);
    return true;
  }

  tables.forEach((table) => table.tHead.addEventListener("click", (event) => {
    const key = event.target.closest("button")?.dataset.key;
    if (!key) return;
    const now = event.target.closest("th").getAttribute("aria-sort");
    const direction = now === "ascending" ? "descending" : "ascending";
    sort(table, key, direction);
    state.set(table.id, key + "." + direction);
    remember();
  }));

  function filter() {
    const wanted = document.getElementById("q").value.trim().toLowerCase();
    const most = Number(document.getElementById("frames").value) || Infinity;
    const boxes = all("input[name=provenance]", form);
    const allowed = new Set(boxes.filter((box) => box.checked).map((box) => box.value));
    const shown = new Set();
    tables.forEach((table, number) => {
      const rows = all("tbody tr", table);
      rows.forEach((row) => {
        const data = row.dataset;
        const keep = data.search.includes(wanted) && Number(data.frames) <= most && allowed.has(data.provenance);
        row.hidden = !keep;
        if (keep) shown.add(row.id);
      });
      const count = rows.filter((row) => !row.hidden).length;
      const said = count === rows.length ? "" : count + " of " + rows.length + " rows shown";
      document.getElementById("c" + number).textContent = said;
    });
    all("[data-row]").forEach((part) => { part.style.display = shown.has(part.dataset.row) ? "" : "none"; });
    all("[data-of]").forEach((row) => { row.hidden = !shown.has(row.dataset.of); });
    const entries = { q: wanted, frames: most === Infinity ? "" : String(most) };
    entries.hide = boxes.filter((box) => !box.checked).map((box) => box.value).join(",");
    for (const [key, value] of Object.entries(entries)) value ? state.set(key, value) : state.delete(key);
  }

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
    const select = document.getElementById("frames");
    select.value = state.get("frames") || "";
    if (select.selectedIndex < 0) select.value = "";
    const hidden = (state.get("hide") || "").split(",");
    all("input[name=provenance]", form).forEach((box) => { box.checked = !hidden.includes(box.value); });
    filter();
  }

  if (form) {
    form.hidden = false;
    const changed = () => { filter(); remember(); };
    form.addEventListener("input", changed);
    form.addEventListener("submit", (event) => event.preventDefault());
    form.addEventListener("reset", () => setTimeout(changed));
  }

  // A row and its mark in the picture point at each other.
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
