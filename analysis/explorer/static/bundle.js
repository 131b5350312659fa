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
  window.explorer = {
    panel: async (link) => trial.panels[`${link.dataset.side}/${link.dataset.n}`],
    data: async (option) => (await unpacked(trials[option.dataset.url])).data,
  };
  document.getElementById("shown").innerHTML = trial.html;
  document.title = `${chosen.text.replace(/: [^:]*$/, "")} · merge-runner`;
  startReplay();
})();
