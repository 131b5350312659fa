"use strict";
// A second trial beside this one: found by words, or offered.
replay.comparison = (scene, { changed }) => {
  const at = (id) => document.getElementById(id);
  const form = at("compare-form"),
    field = at("compare"),
    list = at("others");
  if (!form) return { lay: async () => {} }; // of a page without a server
  const say = (...words) => {
    at("ghost-key").hidden = words.length === 0;
    at("ghost-key").replaceChildren(...words);
  };
  // What somebody answers; undefined, and said, where nobody does.
  const answered = async (asked) => {
    const answer = await asked.catch(() => undefined);
    at("lost").hidden = answer !== undefined;
    return answer;
  };
  const described = () => [
    "dashed: ",
    replay.element("a", { href: scene.ghost.page }, scene.ghost.label),
    `. ${scene.ghost.outcome}`,
  ];
  // An address names a trial by its name alone, or as NAME@SPEC.
  const lay = async (key, push) => {
    const found = key ? ((await answered(explorer.data(key))) ?? null) : null;
    scene.ghost = found;
    if (found) found.named = key;
    say(...(found ? described() : key ? [`${key} is not there to compare with, or nothing was driven in it`] : []));
    field.value = "";
    at("alone").hidden = !found;
    changed(push);
  };
  form.addEventListener("click", async (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    // What is chosen is done with: the keys are the replay's again.
    button.blur();
    if (button === at("alone")) return lay("", true);
    const key = await answered(explorer.offer(button.dataset.offer));
    if (key) lay(key, true);
    else if (key === null) say(`${button.textContent}: there is none here. It would be ${button.title}.`);
  });
  const suggest = async () => {
    const text = field.value.trim();
    if ([...list.options].some(({ value }) => value === text)) return form.requestSubmit();
    const answer = await answered(explorer.search(text));
    if (!answer || field.value.trim() !== text) return;
    const option = ({ key, outcome, note }) => new Option(note ? `${outcome}, ${note}` : outcome, key);
    list.replaceChildren(...answer.found.map(option));
  };
  field.addEventListener("input", suggest);
  field.addEventListener("focus", suggest);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const text = field.value.trim(),
      known = [...list.options].find(({ value }) => value === text);
    const key = known?.value ?? (await answered(explorer.search(text)))?.found[0]?.key;
    field.blur();
    if (key) lay(key, true);
    else say("No trial has these words in its name, driver or outcome.");
  });
  return { lay };
};
