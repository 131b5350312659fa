"use strict";
// A list keeps its place: the row that was opened last is chosen, and a trial leads to its neighbours.
(() => {
  const rows = () => [...document.querySelectorAll("[data-list] tbody tr")];
  const leads = (row) => row.querySelector("a")?.href;
  const kept = () => JSON.parse(sessionStorage.getItem("list") ?? "null");
  const keep = (list) => sessionStorage.setItem("list", JSON.stringify(list));
  // A page without a server may hold several trials; a name may have several specs.
  const same = (a, b) => {
    const [one, other] = [new URL(a), new URL(b)];
    const [spec, another] = [one, other].map((url) => url.searchParams.get("spec"));
    const named = (url) => url.pathname + url.searchParams.get("trial");
    return named(one) === named(other) && (!spec || !another || spec === another);
  };
  // Where several rows are of one trial, as its decisions are, it counts once.
  const distinct = (hrefs) =>
    hrefs.filter((href, i) => href && !hrefs.slice(0, i).some((other) => other && same(href, other)));
  // A file cannot read another one.
  const page = (rel) =>
    location.protocol === "file:" ? undefined : document.querySelector(`.paging a[rel=${rel}]`)?.href;

  // ---- in a list

  let address = null;
  const place = () => rows().findIndex((row) => row.classList.contains("chosen"));
  const choose = (row, focus) => {
    if (!row) return;
    rows()[place()]?.classList.remove("chosen");
    row.classList.add("chosen");
    address = leads(row);
    if (focus) row.querySelector("a")?.focus({ preventScroll: true });
    row.scrollIntoView({ block: "nearest" });
  };
  // Rows that come anew are the same where only something in them has changed.
  document.addEventListener("htmx:afterSwap", () => {
    rows()
      .find((row) => address && leads(row) === address)
      ?.classList.add("chosen");
  });
  document.addEventListener("click", (event) => {
    const row = event.target.closest("[data-list] tbody tr");
    if (!row || event.target.closest("a") !== row.querySelector("a")) return;
    const hrefs = distinct(rows().map(leads));
    keep({ address: location.href, rows: hrefs, open: leads(row), next: page("next"), prev: page("prev") });
  });
  addEventListener("pageshow", () => {
    const list = kept();
    if (list?.address === location.href)
      choose(
        rows().find((row) => leads(row) === list.open),
        false,
      );
  });

  // ---- on the page of a trial

  const here = (list) => list?.rows.findIndex((row) => same(row, location.href)) ?? -1;
  const links = () => [document.getElementById("previous-trial"), document.getElementById("next-trial")];
  window.place = {
    lead: () => {
      const list = kept(),
        at = here(list);
      if (at < 0) return;
      keep({ ...list, open: list.rows[at] });
      const hrefs = [list.rows[at - 1] ?? list.prev, list.rows[at + 1] ?? list.next];
      links().forEach((link, i) => {
        link.hidden = !hrefs[i];
        if (hrefs[i]) link.href = hrefs[i];
      });
    },
    // The page that led here, or the list whose rows were gone through.
    back: () => {
      const from = document.referrer && new URL(document.referrer);
      const led = from && from.origin === location.origin && !from.pathname.startsWith("/trials/");
      if (led && from.pathname !== location.pathname) return from.href;
      return here(kept()) >= 0 ? kept().address : document.getElementById("trial").dataset.back;
    },
    step: (by) => {
      const all = rows();
      if (!document.getElementById("trial")) choose(all[Math.min(Math.max(place() + by, 0), all.length - 1)], true);
      else
        links()
          .find((link, i) => !link.hidden && i === (by > 0 ? 1 : 0))
          ?.click();
    },
  };
})();
