"use strict";
// The list of trials of an exported study: filtered here, where no server does it, and shown a page
// at a time. Its rows are packed some hundred together.
(async () => {
  const { index, rows, block, page: length } = JSON.parse(document.getElementById("packed-list").textContent);
  const { names, levels, cells, sets } = await unpacked(index);
  const form = document.getElementById("listing"), paging = document.getElementById("paging");
  const [before, told, after] = paging.children;
  const asked = new URL(location.href).searchParams;
  for (const [name, value] of asked) if (form.elements[name]) form.elements[name].value = value;
  const cell = asked.get("cell");
  let number = Number(asked.get("page")) || 1;
  if (cell) {
    const note = document.getElementById("behind");
    // As on the other pages: what does not show stands there as its code point.
    note.querySelector("strong").textContent = cell.replace(/\p{C}/gu, (c) => `[U+${c.codePointAt(0).toString(16).toUpperCase().padStart(4, "0")}]`);
    note.hidden = false;
  }
  const candidates = cell ? [...(sets[cells[cell]] ?? [])].sort((a, b) => a - b) : names.map((_, i) => i);
  // Which trials have a value, as a question of their place in the list.
  const having = ([name, value]) => {
    if (name === "q") return (i) => names[i].includes(value.toLowerCase());
    const { values, of } = levels[name], wanted = values.indexOf(value);
    return (i) => (Array.isArray(of[i]) ? of[i].includes(wanted) : of[i] === wanted);
  };
  const opened = [];
  const row = async (i) => {
    const place = Math.floor(i / block);
    opened[place] ??= unpacked(rows[place]);
    return (await opened[place])[i % block];
  };
  const address = (wanted, page) => {
    const state = [...wanted, ...(cell ? [["cell", cell]] : []), ...(page > 1 ? [["page", page]] : [])];
    return `${location.pathname.split("/").at(-1)}${state.length ? "?" : ""}${new URLSearchParams(state)}`;
  };
  let latest = 0;
  const list = async () => {
    const turn = ++latest;
    const wanted = [...new FormData(form)].filter(([, value]) => value);
    const tests = wanted.map(having);
    const found = candidates.filter((i) => tests.every((test) => test(i)));
    const last = Math.max(1, Math.ceil(found.length / length));
    number = Math.min(Math.max(number, 1), last);
    const shown = await Promise.all(found.slice(length * (number - 1), length * number).map(row));
    if (turn !== latest) return; // something else was asked for meanwhile
    document.querySelector("[data-list] tbody").innerHTML = shown.join("");
    document.getElementById("listed").textContent = found.length;
    paging.hidden = last === 1;
    told.textContent = `page ${number} of ${last}`;
    for (const [link, page] of [[before, number - 1], [after, number + 1]]) {
      link.hidden = page < 1 || page > last;
      link.href = address(wanted, page);
    }
    history.replaceState(null, "", address(wanted, number));
  };
  form.addEventListener("input", () => { number = 1; list(); });
  form.addEventListener("submit", (event) => event.preventDefault());
  paging.addEventListener("click", (event) => {
    const by = { prev: -1, next: 1 }[event.target.rel];
    if (!by || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    number += by;
    list().then(() => document.querySelector("[data-list]").scrollIntoView());
  });
  await list();
  place.restore();
})();
