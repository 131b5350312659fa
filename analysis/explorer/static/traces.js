"use strict";
// Of an exported condition the traces of a driver and a prompt are chosen here.
(() => {
  const form = document.getElementById("choice");
  if (!form) return;
  const groups = [...document.querySelectorAll(".overlay [data-model]")];
  const drivers = groups.some((group) => group.dataset.model !== "human");
  const { model, variant } = form.elements;
  for (const [name, value] of new URL(location.href).searchParams) if (form.elements[name]) form.elements[name].value = value;
  const show = () => {
    for (const group of groups) {
      const driver = group.dataset.model;
      const wanted = model.value ? driver === model.value : driver !== "human" || !drivers;
      group.toggleAttribute("hidden", !wanted || (variant.value && group.dataset.variant !== variant.value));
    }
    // The other views are pages of their own, and keep the choice.
    const chosen = new URLSearchParams([...new FormData(form)].filter(([name, value]) => name !== "by" && value));
    for (const link of document.querySelectorAll(".groups a")) {
      const [page] = link.getAttribute("href").split("?");
      link.setAttribute("href", chosen.size ? `${page}?${chosen}` : page);
    }
    document.getElementById("drawn").textContent = document.querySelectorAll(".overlay [data-model]:not([hidden]) path").length;
  };
  form.addEventListener("input", show);
  form.addEventListener("submit", (event) => event.preventDefault());
  show();
})();
