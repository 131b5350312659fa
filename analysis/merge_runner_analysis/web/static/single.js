"use strict";
// A page without a server that holds several trials, each in a template: the address names the one shown.
(() => {
  const held = [...document.querySelectorAll("template.held")];
  const shown = (href) => {
    const asked = new URL(href).searchParams;
    return held.find(({ dataset }) => dataset.trial === asked.get("trial") && dataset.spec === asked.get("spec"));
  };
  const chosen = shown(location.href) ?? held[0];
  document.getElementById("shown").replaceChildren(chosen.content.cloneNode(true));
  document.title = `${document.querySelector("h1").textContent} · merge-runner`;
  for (const link of document.querySelectorAll(".few a")) {
    if (shown(link.href) === chosen) link.ariaCurrent = "page";
  }
  startReplay();
})();
