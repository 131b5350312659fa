"use strict";
// A second trial beside this one: found by words, or offered.
replay.comparison = (scene, changed) => {
  const { at, element } = replay;
  const form = at("compare-form"),
    field = at("compare"),
    list = at("others");
  if (!form) return { lay: async () => {} }; // of a page without a server
  const say = (...words) => {
    at("ghost-key").hidden = words.length === 0;
    at("ghost-key").replaceChildren(...words);
  };
  // What the server answers; undefined, and said, where it does not.
  const ask = async (what) => {
    const address = `${at("trial").dataset.others}&${new URLSearchParams(what)}`;
    const answer = await fetch(address)
      .then((reply) => (reply.ok ? reply.json() : undefined))
      .catch(() => undefined);
    at("lost").hidden = answer !== undefined;
    return answer;
  };
  // An address names a trial by its name alone, or as NAME@SPEC.
  const lay = async (key, push) => {
    const ghost = (key && (await ask({ compare: key }))) || null;
    scene.ghost = ghost && { ...ghost, named: key };
    if (ghost) say("dashed: ", element("a", { href: ghost.page }, ghost.label), `. ${ghost.outcome}`);
    else say(...(key ? [`${key} is not there to compare with, or nothing was driven in it`] : []));
    field.value = "";
    at("alone").hidden = !ghost;
    changed(push);
  };
  form.addEventListener("click", async ({ target }) => {
    const button = target.closest("button");
    if (!button) return;
    // What is chosen is done with: the keys are the replay's again.
    button.blur();
    if (button === at("alone")) return lay("", true);
    const key = await ask({ offer: button.dataset.offer });
    if (key) lay(key, true);
    else if (key === null) say(`There is no ${button.textContent}: it would be ${button.title}.`);
  });
  const known = () => [...list.options].some(({ value }) => value === field.value);
  const suggest = async () => {
    if (known()) return form.requestSubmit();
    const text = field.value;
    const answer = await ask({ q: text });
    if (!answer || field.value !== text) return; // the answer to later words may have come before
    list.replaceChildren(
      ...answer.found.map(({ key, outcome, note }) => new Option([outcome, note].filter(Boolean).join(", "), key)),
    );
  };
  field.addEventListener("input", suggest);
  field.addEventListener("focus", suggest);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const text = field.value;
    const key = known() ? text : (await ask({ q: text }))?.found[0]?.key;
    field.blur();
    if (key) lay(key, true);
    else say("No trial has these words in its name, driver or outcome.");
  });
  return { lay };
};
