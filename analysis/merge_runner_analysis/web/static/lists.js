"use strict";
// A trial leads to its neighbours in the list that led to it, and back to the list.
(() => {
  // On a phone a row is a card, in which each value has the head of its column.
  window.label = (part) => {
    for (const table of part.querySelectorAll("table")) {
      const heads = [...table.querySelectorAll("thead th")].map((head) => head.textContent.trim());
      for (const row of table.rows) {
        [...row.cells].forEach((cell, i) => cell.tagName === "TD" && (cell.dataset.l ??= heads[i] ?? ""));
      }
    }
  };
  label(document);

  // A page without a server may hold several trials; a name may have several specs.
  const key = (href) => {
    const { pathname, searchParams } = new URL(href);
    return [pathname, searchParams.get("trial"), searchParams.get("spec")].join();
  };
  document.addEventListener("click", ({ target }) => {
    const row = target.closest("tbody tr");
    if (!row || target.closest("a") !== row.querySelector("a")) return;
    const hrefs = [...document.querySelectorAll("tbody tr")].map((one) => one.querySelector("a")?.href);
    // Where several rows are of one trial, as its decisions are, it counts once.
    const rows = [...new Map(hrefs.filter(Boolean).map((href) => [key(href), href])).values()];
    sessionStorage.setItem("list", JSON.stringify({ address: location.href, rows }));
  });

  const list = JSON.parse(sessionStorage.getItem("list") ?? "null");
  const here = () => list?.rows.findIndex((href) => key(href) === key(location.href)) ?? -1;
  window.place = {
    lead: () => {
      const at = here();
      for (const [id, href] of Object.entries({ previous: list?.rows[at - 1], next: at >= 0 && list.rows[at + 1] })) {
        if (href) Object.assign(document.getElementById(`${id}-trial`), { href, hidden: false });
      }
    },
    // The page that led here, or the list whose rows were gone through.
    back: () => {
      const from = document.referrer && new URL(document.referrer);
      const led = from && from.origin === location.origin && !from.pathname.startsWith("/trials/");
      if (led && from.pathname !== location.pathname) return from.href;
      return here() >= 0 ? list.address : document.getElementById("trial").dataset.back;
    },
    // In a list of trials the keys go from row to row.
    step: (id) => {
      const rows = [...document.querySelectorAll(".of-trials tbody a, .hits tbody th a")];
      const to = rows[rows.indexOf(document.activeElement) + (id === "next" ? 1 : -1)];
      (to ?? document.body).focus();
      document.querySelector(`#${id}-trial[href]`)?.click();
    },
  };
})();
