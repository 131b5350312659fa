"use strict";
// An exported page holds many trials, each compressed by itself, and what they share beside them;
// the address names the one shown.
(async () => {
  const { blocks, trials } = JSON.parse(document.getElementById("bundle").textContent);
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
  window.explorer = {
    panel: async (link) => trial.panel(`${link.dataset.side}/${link.dataset.n}`),
    data: async (option) => {
      const { html } = await opened(option.dataset.url);
      return JSON.parse(new DOMParser().parseFromString(html, "text/html").getElementById("replay-data").textContent);
    },
  };
  document.getElementById("shown").innerHTML = trial.html;
  // To compare with there are the other trials of the page, each by its name, and its spec where
  // that name has several.
  const names = options.map((o) => o.value.split("|")[0]);
  for (const group of chooser.children) {
    const offered = group.cloneNode(true);
    for (const option of [...offered.children]) {
      const [name, spec] = option.value.split("|");
      option.dataset.url = option.value;
      if (option.value === chosen.value) option.remove();
      option.value = names.indexOf(name) === names.lastIndexOf(name) ? name : `${name}@${spec}`;
    }
    document.getElementById("compare")?.append(offered);
  }
  document.title = `${chosen.text.replace(/: [^:]*$/, "")} · merge-runner`;
  startReplay();
})();
