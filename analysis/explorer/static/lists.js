"use strict";
// A trial leads to its neighbours in the list that led to it, and back to the list.
(() => {
  // A page without a server may hold several trials; a name may have several specs.
  const key = (href) => {
    const { pathname, searchParams } = new URL(href);
    return [pathname, searchParams.get("trial"), searchParams.get("spec")].join();
  };
  const keep = (list) => sessionStorage.setItem("list", JSON.stringify(list));
  // A file cannot read another one.
  const page = (rel) =>
    location.protocol === "file:" ? undefined : document.querySelector(`.paging a[rel=${rel}]`)?.href;

  document.addEventListener("click", (event) => {
    const row = event.target.closest("[data-list] tbody tr");
    if (!row || event.target.closest("a") !== row.querySelector("a")) return;
    const hrefs = [...document.querySelectorAll("[data-list] tbody tr")].map((one) => one.querySelector("a")?.href);
    // Where several rows are of one trial, as its decisions are, it counts once.
    const rows = [...new Map(hrefs.filter(Boolean).map((href) => [key(href), href])).values()];
    keep({ address: location.href, rows, next: page("next"), prev: page("prev") });
  });

  const list = JSON.parse(sessionStorage.getItem("list") ?? "null");
  const here = () => list?.rows.findIndex((href) => key(href) === key(location.href)) ?? -1;
  const links = () => ["previous-trial", "next-trial"].map((id) => document.getElementById(id));
  window.place = {
    lead: () => {
      const at = here();
      if (at < 0) return;
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
      return here() >= 0 ? list.address : document.getElementById("trial").dataset.back;
    },
    step: (by) => {
      const link = document.getElementById("trial") && links()[by > 0 ? 1 : 0];
      if (link && !link.hidden) link.click();
    },
  };
})();
