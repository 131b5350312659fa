"use strict";
// A list keeps its place: the row that was opened last is chosen, and a trial leads to its neighbours.
(() => {
  const rowsOf = (page) => [...page.querySelectorAll("[data-list] tbody tr:not([hidden])")];
  const leads = (row) => row.querySelector("a")?.href;
  // A file cannot read another one.
  const turn = (page, rel) => (location.protocol === "file:" ? undefined : page.querySelector(`.paging a[rel=${rel}]`)?.href);
  const kept = () => JSON.parse(sessionStorage.getItem("list") ?? "null");
  const keep = (list) => sessionStorage.setItem("list", JSON.stringify(list));
  // A page without a server may hold several trials; a name may have several specs.
  const same = (one, other) => {
    const [a, b] = [one, other].map((text) => new URL(text));
    const spec = [a, b].map((url) => url.searchParams.get("spec"));
    return a.pathname === b.pathname && a.searchParams.get("trial") === b.searchParams.get("trial")
      && (!spec[0] || !spec[1] || spec[0] === spec[1]);
  };
  // Where several rows are of one trial, as its decisions are, it counts once.
  const distinct = (hrefs) => hrefs.filter((href, i) => href && hrefs.findIndex((other) => other && same(other, href)) === i);
  const listed = (page, address) => ({ address, rows: distinct(rowsOf(page).map(leads)), next: turn(page, "next"), prev: turn(page, "prev") });

  // ---- in a list

  let chosen = -1, address = null;
  const choose = (place, focus) => {
    const rows = rowsOf(document);
    if (!rows.length) return;
    rows[chosen]?.classList.remove("chosen");
    chosen = Math.min(Math.max(place, 0), rows.length - 1);
    rows[chosen].classList.add("chosen");
    address = leads(rows[chosen]);
    if (focus) rows[chosen].querySelector("a")?.focus({ preventScroll: true });
    rows[chosen].scrollIntoView({ block: "nearest" });
  };
  // Rows that come anew are the same where only something in them has changed.
  document.addEventListener("htmx:afterSwap", () => {
    const rows = rowsOf(document);
    chosen = rows.findIndex((row) => address && leads(row) === address);
    rows[chosen]?.classList.add("chosen");
  });
  document.addEventListener("click", (event) => {
    const row = event.target.closest("[data-list] tbody tr");
    if (row && event.target.closest("a") === row.querySelector("a")) keep({ ...listed(document, location.href), open: leads(row) });
  });
  const restore = () => {
    const list = kept();
    if (list?.address !== location.href) return;
    const place = rowsOf(document).findIndex((row) => leads(row) === list.open);
    if (place >= 0) choose(place, false);
  };
  addEventListener("pageshow", restore);

  // ---- on the page of a trial

  const here = (list) => list?.rows.findIndex((row) => row && same(row, location.href)) ?? -1;
  const lead = () => {
    const list = kept(), place = here(list);
    if (place < 0) return;
    keep({ ...list, open: list.rows[place] });
    const beside = { "previous-trial": list.rows[place - 1] ?? list.prev, "next-trial": list.rows[place + 1] ?? list.next };
    for (const [id, href] of Object.entries(beside)) {
      const link = document.getElementById(id);
      link.hidden = !href;
      if (href) link.href = href;
    }
  };
  const go = async (by) => {
    let list = kept();
    const place = here(list);
    if (place < 0) return;
    let wanted = list.rows[place + by];
    const page = by > 0 ? list.next : list.prev;
    if (!wanted && page) {
      const reply = await fetch(page);
      list = listed(new DOMParser().parseFromString(await reply.text(), "text/html"), page);
      wanted = by > 0 ? list.rows[0] : list.rows.at(-1);
    }
    if (!wanted) return;
    keep({ ...list, open: wanted });
    location.href = wanted;
  };
  document.addEventListener("click", (event) => {
    const link = event.target.closest("#previous-trial, #next-trial");
    if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    go(link.id === "next-trial" ? 1 : -1);
  });
  // The page that led here, or the list whose rows were gone through.
  const back = () => {
    const from = document.referrer && new URL(document.referrer);
    if (from && from.origin === location.origin && from.pathname !== location.pathname && !from.pathname.startsWith("/trials/")) return from.href;
    const list = kept();
    return here(list) >= 0 ? list.address : document.getElementById("trial").dataset.back;
  };
  window.place = {
    lead, back,
    step: (by) => (document.getElementById("trial") ? go(by) : choose(chosen + by, true)),
  };
})();
