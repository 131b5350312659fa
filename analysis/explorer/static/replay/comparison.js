"use strict";
// A second trial beside this one: found by its name, or offered.
replay.comparison = (scene, { changed }) => {
  const PAUSE_MS = 200;
  const at = (id) => document.getElementById(id);
  const field = at("compare"), list = at("others");
  let waiting = 0, asked = "";

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
  const close = () => { list.hidden = true; };
  const entry = (one) => replay.element("li", {},
    replay.element("button", { type: "button", "data-key": one.key }, `${one.name}: ${one.outcome}${one.note ? `, ${one.note}` : ""}`));
  const search = async () => {
    const text = field.value.trim();
    asked = text;
    const { found, more } = await explorer.search(text).catch(() => ({ found: [], more: 0 }));
    if (asked !== text || !field.matches(":focus")) return;
    const note = found.length === 0 ? "No trial has these words in its name, driver or outcome."
      : more ? `${more} more: type more of a name, driver or outcome.` : "";
    list.replaceChildren(...found.map(entry), ...(note ? [replay.element("li", { class: "quiet" }, note)] : []));
    list.hidden = false;
  };
  const soon = () => {
    clearTimeout(waiting);
    waiting = setTimeout(search, PAUSE_MS);
  };
  const walk = (event, by) => {
    const stops = [field, ...list.querySelectorAll("button")];
    stops[Math.min(Math.max(stops.indexOf(event.target) + by, 0), stops.length - 1)].focus();
    event.preventDefault();
  };
  field.addEventListener("input", soon);
  field.addEventListener("focus", () => { field.select(); if (list.hidden) soon(); });
  at("compare-form").addEventListener("focusout", (event) => {
    if (!at("compare-form").contains(event.relatedTarget)) close();
  });
  at("compare-form").addEventListener("submit", (event) => {
    event.preventDefault();
    list.querySelector("button")?.click();
  });
  at("compare-form").addEventListener("keydown", (event) => {
    if (event.key === "ArrowDown" && !list.hidden) walk(event, 1);
    else if (event.key === "ArrowUp" && !list.hidden) walk(event, -1);
    else if (event.key === "Escape") { close(); document.activeElement.blur(); event.preventDefault(); }
    event.stopPropagation();
  });
  at("compare-form").addEventListener("click", async (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    // What is chosen is done with: the keys are the replay's again.
    button.blur();
    if (button.dataset.offer) {
      const key = await explorer.offer(button.dataset.offer).catch(() => null);
      if (key) lay(key, true);
      else say(`${button.textContent}: there is none here. It would be ${button.title}.`);
    } else if (button.dataset.key !== undefined) lay(button.dataset.key, true);
  });
  return { lay };
};
