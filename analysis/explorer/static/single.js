"use strict";
// A page without a server that holds several trials, each in a template: the address names the one shown.
(() => {
  const held = [...document.querySelectorAll("template.held")];
  const find = (trial, spec) => held.find(({ dataset }) => dataset.trial === trial && (!spec || dataset.spec === spec));
  // An address names a trial by its name alone, or as NAME@SPEC.
  const named = (key) => find(key) ?? find(...key.split(/@(?=[^@]*$)/));
  const shown = (href, asked = new URL(href).searchParams) => find(asked.get("trial"), asked.get("spec"));
  const chosen = shown(location.href) ?? held[0];
  window.explorer = {
    data: async (key) => {
      const one = named(key),
        part = (id) => one?.content.getElementById(id);
      if (!part("replay-data")) return null;
      const { trial, spec } = one.dataset;
      return {
        ...JSON.parse(part("replay-data").textContent),
        page: `?${new URLSearchParams({ trial, spec })}`,
        ribbons: part("ribbons").innerHTML,
        panels: part("panels").textContent,
      };
    },
    search: async (text) => {
      const words = text.toLowerCase().split(/\s+/);
      const fit = held.filter((one) => one !== chosen && words.every((word) => one.dataset.words.includes(word)));
      return {
        found: fit.map(({ dataset }) => ({ key: `${dataset.trial}@${dataset.spec}`, outcome: dataset.outcome })),
      };
    },
  };
  document.getElementById("shown").replaceChildren(chosen.content.cloneNode(true));
  document.title = `${document.querySelector("h1").textContent} · merge-runner`;
  for (const link of document.querySelectorAll(".few a")) {
    if (shown(link.href) === chosen) link.ariaCurrent = "page";
  }
  startReplay();
})();
