"use strict";
// The list of trials of an exported study: filtered here, where no server does it.
(() => {
  const form = document.getElementById("listing");
  const rows = [...document.querySelectorAll("[data-list] tbody tr")];
  const asked = new URL(location.href).searchParams;
  for (const [name, value] of asked) if (form.elements[name]) form.elements[name].value = value;
  const filter = () => {
    const wanted = [...new FormData(form)].filter(([, value]) => value);
    let shown = 0;
    for (const row of rows) {
      row.hidden = !wanted.every(([name, value]) =>
        name === "q" ? row.dataset.name.includes(value.toLowerCase()) : row.dataset[name].split("\n").includes(value));
      shown += !row.hidden;
    }
    document.getElementById("listed").textContent = shown;
    const address = new URL(location.href);
    address.search = new URLSearchParams(wanted);
    if (address.href !== location.href) history.replaceState(null, "", address);
  };
  form.addEventListener("input", filter);
  form.addEventListener("submit", (event) => event.preventDefault());
  filter();
})();
