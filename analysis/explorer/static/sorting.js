"use strict";
// The heads of tables sort them: by numbers where a column has any, what has no value last.
// The address keeps by what: ?sorted=TABLE.COLUMN, with - before it for the largest first.
(() => {
  const value = (row, column) => {
    const cell = row.cells[column];
    const text = (cell?.dataset.value ?? cell?.textContent ?? "").trim().replace("−", "-");
    const found = text.match(/^[+<]?(-?\d+(?:\.\d+)?)/);
    return { text, number: found ? Number(found[1]) : NaN };
  };
  const sort = (table, column, down) => {
    const body = table.tBodies[0], sign = down ? -1 : 1;
    const rows = [...body.rows].map((row) => ({ row, ...value(row, column) }));
    const numbers = rows.some(({ number }) => !Number.isNaN(number));
    const absent = ({ text, number }) => (numbers ? Number.isNaN(number) : text === "" || text === "–");
    rows.sort((a, b) => absent(a) - absent(b) || (absent(a) ? 0
      : sign * (numbers ? a.number - b.number : a.text.localeCompare(b.text, "en", { numeric: true }))));
    body.append(...rows.map(({ row }) => row));
    [...table.tHead.rows[0].cells].forEach((head, i) => {
      head.ariaSort = i === column ? (down ? "descending" : "ascending") : "none";
    });
  };
  const asked = () => /^(-?)(.+)\.(\d+)$/.exec(new URL(location.href).searchParams.get("sorted") ?? "");
  const clicked = (table, column) => {
    const heads = table.tHead.rows[0].cells;
    const numbers = [...table.tBodies[0].rows].some((row) => !Number.isNaN(value(row, column).number));
    const before = heads[column].ariaSort;
    const down = before === "ascending" || (before !== "descending" && numbers);
    sort(table, column, down);
    const address = new URL(location.href);
    address.searchParams.set("sorted", `${down ? "-" : ""}${table.id}.${column}`);
    history.replaceState(history.state, "", address);
  };
  const prepare = () => {
    for (const table of document.querySelectorAll("table[data-sort]:not([data-sort=ready])")) {
      table.dataset.sort = "ready";
      [...table.tHead.rows[0].cells].forEach((head, column) => {
        const button = document.createElement("button");
        button.type = "button";
        button.className = "sorts";
        button.append(...head.childNodes);
        button.addEventListener("click", () => clicked(table, column));
        head.append(button);
      });
      const wanted = asked();
      if (wanted && wanted[2] === table.id && table.tHead.rows[0].cells[wanted[3]]) sort(table, Number(wanted[3]), wanted[1] === "-");
    }
  };
  document.addEventListener("htmx:load", prepare);
  prepare();
})();
