"use strict";
// The words of an exported study, searched in the browser as the server does it.
(async () => {
  const AROUND = 70, MOST = 20, PAGE = 50;
  const { trials, said } = await unpacked(JSON.parse(document.getElementById("said").textContent));
  const form = document.getElementById("words"), body = document.querySelector(".hits tbody");
  const paging = document.getElementById("paging");
  const asked = new URL(location.href).searchParams;
  for (const [name, value] of asked) if (form.elements[name]) form.elements[name].value = value;
  let page = Number(asked.get("page")) || 1;
  // A character for each of the text, so that places in the one are places in the other.
  const fold = (text) => Array.from(text, (c) => (c.toLowerCase().length === c.length ? c.toLowerCase() : c)).join("").replace(/[\n\r\t]/g, " ");
  for (const one of said) one.folded = fold(one.text);
  const terms = (query) => [...fold(query).matchAll(/"([^"]*)"?|([^\s"]+)/g)]
    .map((found) => (found[1] ?? found[2]).trim().replace(/\s+/g, " ")).filter(Boolean);

  const spans = (folded, wanted) => {
    const found = wanted.flatMap((term) => {
      const places = [];
      for (let at = folded.indexOf(term); at >= 0; at = folded.indexOf(term, at + 1)) places.push([at, at + term.length]);
      return places;
    }).sort((a, b) => a[0] - b[0]);
    const merged = [];
    for (const [begin, end] of found) {
      const last = merged.at(-1);
      if (last && begin <= last[1]) last[1] = Math.max(last[1], end);
      else merged.push([begin, end]);
    }
    return merged;
  };
  const snippet = (cell, { text, folded }, wanted) => {
    const found = spans(folded, wanted), shown = found.slice(0, MOST);
    let at = 0;
    for (const [i, [begin, end]] of (shown.length ? shown : [[0, 0]]).entries()) {
      const following = shown[i + 1]?.[0] ?? text.length;
      let start = Math.max(at, begin - AROUND);
      if (start > at) {
        const space = text.indexOf(" ", start - 1);
        if (space >= 0 && space < begin) start = space + 1;
        cell.append(at ? " … " : "… ");
      }
      cell.append(text.slice(start, begin));
      if (end > begin) cell.append(Object.assign(document.createElement("mark"), { textContent: text.slice(begin, end) }));
      at = Math.min(following, end + AROUND * (shown.length ? 1 : 3));
      const last = text.lastIndexOf(" ", at);
      if (at < following && last > end) at = last;
      cell.append(text.slice(end, at));
    }
    if (at < text.length) cell.append(" …");
    if (found.length > shown.length) cell.append(` and ${found.length - shown.length} more`);
  };
  const row = (one, wanted) => {
    const of = trials[one.of], made = document.createElement("tr");
    const head = made.appendChild(document.createElement("th"));
    head.scope = "row";
    head.append(Object.assign(document.createElement("a"), { href: `${of.href}&${one.query}`, textContent: of.name }), " ",
      Object.assign(document.createElement("span"), { className: `outcome ${of.outcome[0].replaceAll(" ", "-")}`, textContent: of.outcome[0] }));
    made.insertCell().textContent = one.at;
    made.insertCell().textContent = [one.tactical, one.switch, one.failure].filter(Boolean).join(", ");
    const words = made.insertCell();
    words.className = "words";
    words.dir = "ltr";
    if (one.text) snippet(words, one, wanted);
    else words.textContent = "no words";
    return made;
  };
  const show = () => {
    const given = Object.fromEntries([...new FormData(form)].filter(([, value]) => value));
    const { q = "", ...facets } = given, wanted = terms(q);
    const fits = (one, name, value) => (name in one ? one[name] === value : trials[one.of][name].includes(value));
    const found = said.filter((one) => wanted.every((term) => one.folded.includes(term))
      && Object.entries(facets).every(([name, value]) => fits(one, name, value)));
    const last = Math.max(1, Math.ceil(found.length / PAGE));
    page = Math.min(page, last);
    body.replaceChildren(...found.slice((page - 1) * PAGE, page * PAGE).map((one) => row(one, wanted)));
    document.getElementById("totals").textContent = `${found.length} decisions in ${new Set(found.map((one) => one.of)).size} trials.`;
    paging.hidden = last === 1;
    paging.querySelector("span").textContent = `page ${page} of ${last}`;
    document.getElementById("before").disabled = page === 1;
    document.getElementById("after").disabled = page === last;
    const address = new URL(location.href);
    address.search = new URLSearchParams(page > 1 ? { ...given, page } : given);
    if (address.href !== location.href) history.replaceState(null, "", address);
  };
  const turn = (by) => { page += by; show(); };
  document.getElementById("before").addEventListener("click", () => turn(-1));
  document.getElementById("after").addEventListener("click", () => turn(1));
  form.addEventListener("input", () => { page = 1; show(); });
  form.addEventListener("submit", (event) => event.preventDefault());
  show();
  place.restore();
})();
