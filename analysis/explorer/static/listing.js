"use strict";
// The list of trials of an exported study: filtered here, where no server does it.
(async () => {
  const form = document.getElementById("listing");
  const rows = [...document.querySelectorAll("[data-list] tbody tr")];
  const asked = new URL(location.href).searchParams;
  for (const [name, value] of asked) if (form.elements[name]) form.elements[name].value = value;
  const cell = asked.get("cell");
  let behind = null;
  if (cell) {
    const known = await unpacked(JSON.parse(document.getElementById("cells").textContent));
    behind = new Set(known.sets[known.cells[cell]]);
    const note = document.getElementById("behind");
    // As on the other pages: what does not show stands there as its code point.
    note.querySelector("strong").textContent = cell.replace(/\p{C}/gu, (c) => `[U+${c.codePointAt(0).toString(16).toUpperCase().padStart(4, "0")}]`);
    note.hidden = false;
  }
  const fits = (row, name, value) => name === "q"
    ? row.dataset.name.includes(value.toLowerCase())
    : name.startsWith("factor.") ? row.dataset.levels.split("\n").includes(`${name.slice(7)}=${value}`)
    : row.dataset[name].split("\n").includes(value);
  const filter = () => {
    const wanted = [...new FormData(form)].filter(([, value]) => value);
    rows.forEach((row, i) => {
      row.hidden = (behind && !behind.has(i)) || !wanted.every(([name, value]) => fits(row, name, value));
    });
    document.getElementById("listed").textContent = rows.filter((row) => !row.hidden).length;
    const address = new URL(location.href);
    address.search = new URLSearchParams(cell ? [...wanted, ["cell", cell]] : wanted);
    if (address.href !== location.href) history.replaceState(null, "", address);
  };
  form.addEventListener("input", filter);
  form.addEventListener("submit", (event) => event.preventDefault());
  filter();
})();
