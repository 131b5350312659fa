"use strict";
// An exported page holds many trials, each compressed by itself, and what they share beside them;
// the address names the one shown.
(async () => {
  const FOUND = 12;
  const bundle = JSON.parse(document.getElementById("bundle").textContent);
  const listed = await unpacked(bundle.listed), texts = [];
  const opened = async (one) => {
    const [block, text] = bundle.trials[listed.indexOf(one)];
    texts[block] ??= unpacked(bundle.blocks[block]);
    const [shared, trial] = await Promise.all([texts[block], unpacked(text)]);
    const whole = (pieces) => pieces.map((piece) => (typeof piece === "number" ? shared[piece] : piece)).join("");
    return {
      // Links that only a server can follow are none here: their words stay.
      html: whole(trial.html).replace(/<a href="">(.*?)<\/a>/gs, "$1"),
      panel: (name) => whole(trial.panels[name]),
    };
  };
  // An address names a trial by its name alone or, where that has several specs, as NAME@SPEC.
  const find = (trial, spec) => listed.find((one) => one.trial === trial && (!spec || one.spec === spec));
  const named = (key) => find(key) ?? find(...key.split(/@(?=[^@]*$)/));
  const keyOf = ({ trial, spec }) => (listed.filter((one) => one.trial === trial).length > 1 ? `${trial}@${spec}` : trial);
  const asked = new URL(location.href).searchParams, name = asked.get("trial");
  const chosen = find(name, asked.get("spec")) ?? find(name) ?? listed[0];
  const trial = await opened(chosen);
  const part = (html, id) => new DOMParser().parseFromString(html, "text/html").getElementById(id);
  window.explorer = {
    panel: async (link, other) => (other ?? trial).panel(`${link.dataset.side}/${link.dataset.n}`),
    data: async (key) => {
      const one = named(key), other = one && await opened(one);
      const data = other && part(other.html, "replay-data");
      return data ? { ...JSON.parse(data.textContent), ribbons: part(other.html, "ribbons")?.innerHTML ?? "", panel: other.panel } : null;
    },
    search: async (text) => {
      const words = text.toLowerCase().split(/\s+/);
      const fit = listed.filter((one) => one !== chosen && words.every((word) => one.words.includes(word)));
      return { found: fit.slice(0, FOUND).map((one) => ({ ...one, key: keyOf(one) })), more: Math.max(0, fit.length - FOUND) };
    },
    offer: async (kind) => {
      const other = bundle.offers[listed.indexOf(chosen)][kind];
      return other === undefined ? null : keyOf(listed[other]);
    },
  };
  document.getElementById("shown").innerHTML = trial.html;
  document.title = `${chosen.name} · merge-runner`;
  const form = document.getElementById("choose");
  if (form) replay.finding(form);
  form?.addEventListener("click", ({ target }) => {
    const key = target.closest("[data-key]")?.dataset.key;
    if (!key) return;
    const { trial, spec } = named(key);
    location.search = new URLSearchParams({ trial, spec });
  });
  for (const link of document.querySelectorAll(".few a")) {
    const { searchParams } = new URL(link.href);
    if (find(searchParams.get("trial"), searchParams.get("spec")) === chosen) link.ariaCurrent = "page";
  }
  startReplay();
})();
