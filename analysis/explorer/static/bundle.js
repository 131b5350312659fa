"use strict";
// An exported page holds many trials, each compressed by itself, and what they share beside them;
// the address names the one shown.
(async () => {
  const { blocks, trials, offers } = JSON.parse(document.getElementById("bundle").textContent);
  const texts = [];
  const opened = async (key) => {
    const [block, text] = trials[key];
    texts[block] ??= unpacked(blocks[block]);
    const [shared, trial] = await Promise.all([texts[block], unpacked(text)]);
    const whole = (pieces) => pieces.map((piece) => (typeof piece === "number" ? shared[piece] : piece)).join("");
    return {
      // Links that only a server can follow are none here: their words stay.
      html: whole(trial.html).replace(/<a href="">(.*?)<\/a>/gs, "$1"),
      panel: (name) => whole(trial.panels[name]),
    };
  };
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
  const trial = await opened(chosen.value);
  // An address names another trial of the page by its name alone, or as NAME@SPEC.
  const named = (key) => options.find((o) => o.value === key.replace(/@([0-9a-f]+)$/, "|$1"))
    ?? options.find((o) => o.value.startsWith(`${key}|`));
  const keyOf = (option) => {
    const [name, spec] = option.value.split("|");
    return options.filter((o) => o.value.startsWith(`${name}|`)).length > 1 ? `${name}@${spec}` : name;
  };
  const part = (html, id) => new DOMParser().parseFromString(html, "text/html").getElementById(id);
  const OFFERED = 12;
  window.explorer = {
    panel: async (link, other) => (other ?? trial).panel(`${link.dataset.side}/${link.dataset.n}`),
    data: async (key) => {
      const option = named(key), other = option && await opened(option.value);
      const data = other && part(other.html, "replay-data");
      return data ? { ...JSON.parse(data.textContent), ribbons: part(other.html, "ribbons")?.innerHTML ?? "", panel: other.panel } : null;
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
      const option = options.find((o) => o.value === offers[chosen.value]?.[kind]);
      return option ? keyOf(option) : null;
    },
  };
  document.getElementById("shown").innerHTML = trial.html;
  document.title = `${chosen.text.replace(/: [^:]*$/, "")} · merge-runner`;
  startReplay();
})();
