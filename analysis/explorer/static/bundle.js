"use strict";
// An exported page holds many trials, each compressed by itself; the address names the one shown.
(async () => {
  const trials = JSON.parse(document.getElementById("bundle").textContent);
  const chooser = document.getElementById("chooser");
  const asked = new URL(location.href).searchParams;
  const options = [...chooser.options];
  const chosen = options.find((o) => o.value === `${asked.get("trial")}|${asked.get("spec")}`)
    ?? options.find((o) => o.value.startsWith(`${asked.get("trial")}|`)) ?? options[0];
  chooser.value = chosen.value;
  chooser.addEventListener("change", () => {
    const [trial, spec] = chooser.value.split("|");
    location.search = new URLSearchParams({ trial, spec });
  });
  const trial = await unpacked(trials[chosen.value]);
  // An address names another trial of the page by its name alone, or as NAME@SPEC.
  const named = (key) => options.find((o) => o.value === key.replace(/@([0-9a-f]+)$/, "|$1"))
    ?? options.find((o) => o.value.startsWith(`${key}|`));
  const keyOf = (option) => {
    const [name, spec] = option.value.split("|");
    return options.filter((o) => o.value.startsWith(`${name}|`)).length > 1 ? `${name}@${spec}` : name;
  };
  const ribbons = (html) => {
    const held = document.createElement("template");
    held.innerHTML = html;
    return held.content.querySelector("#ribbons")?.innerHTML ?? "";
  };
  const OFFERED = 12;
  window.explorer = {
    panel: async (link, other) => (other ?? trial).panels[`${link.dataset.side}/${link.dataset.n}`],
    data: async (key) => {
      const option = named(key), other = option && await unpacked(trials[option.value]);
      return other?.data ? { ...other.data, ribbons: ribbons(other.html), panels: other.panels } : null;
    },
    search: async (text) => {
      const words = text.toLowerCase().split(/\s+/);
      const fit = options.filter((o) => o !== chosen && words.every((word) => o.text.toLowerCase().includes(word)));
      const found = fit.slice(0, OFFERED).map((o) => {
        const [, name, outcome] = o.text.match(/^(.*): ([^:]*)$/);
        return { key: keyOf(o), name, outcome, note: "" };
      });
      return { found, more: fit.length - found.length };
    },
    offer: async (kind) => {
      const option = options.find((o) => o.value === trial.offers[kind]);
      return option ? keyOf(option) : null;
    },
  };
  document.getElementById("shown").innerHTML = trial.html;
  document.title = `${chosen.text.replace(/: [^:]*$/, "")} · merge-runner`;
  startReplay();
})();
