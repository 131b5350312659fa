"use strict";
// A second trial beside this one: found by its name, or offered.
replay.comparison = (scene, { changed }) => {
  const at = (id) => document.getElementById(id);
  if (!at("compare-form")) return { lay: async () => {} }; // of a page without a server
  const { close, field } = replay.finding(at("compare-form"));
  const say = (...words) => {
    at("ghost-key").hidden = words.length === 0;
    at("ghost-key").replaceChildren(...words);
  };
  const described = () => [
    "dashed: ", replay.element("a", { href: scene.ghost.page }, scene.ghost.label), `. ${scene.ghost.outcome}`,
  ];
  // An address names a trial by its name alone, or as NAME@SPEC.
  const lay = async (key, push) => {
    let found = null;
    try {
      found = key ? await explorer.data(key) : null;
      at("lost").hidden = true;
    } catch {
      at("lost").hidden = false;
    }
    scene.ghost = found;
    if (found) found.named = key;
    say(...(found ? described() : key ? [`${key} is not there to compare with, or nothing was driven in it`] : []));
    field.value = "";
    at("alone").hidden = !found;
    close();
    changed(push);
  };
  at("compare-form").addEventListener("click", async (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    // What is chosen is done with: the keys are the replay's again.
    button.blur();
    if (button.dataset.offer) {
      const key = await explorer.offer(button.dataset.offer).catch(() => undefined);
      at("lost").hidden = key !== undefined;
      if (key) lay(key, true);
      else if (key === null) say(`${button.textContent}: there is none here. It would be ${button.title}.`);
    } else if (button.dataset.key !== undefined) lay(button.dataset.key, true);
  });
  return { lay };
};
