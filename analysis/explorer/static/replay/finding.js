"use strict";
// A form in which a trial is searched: beneath its field is what is found, which the keyboard walks.
replay.finding = (form) => {
  const PAUSE_MS = 200;
  const field = form.querySelector("input"), list = form.querySelector("ul");
  let waiting = 0, asked = "";
  const close = () => { list.hidden = true; };
  const entry = (one) => replay.element("li", {},
    replay.element("button", { type: "button", "data-key": one.key }, `${one.name}: ${one.outcome}${one.note ? `, ${one.note}` : ""}`));
  const look = async () => {
    const text = field.value.trim();
    asked = text;
    const answer = await explorer.search(text).catch(() => null);
    if (asked !== text || !field.matches(":focus")) return;
    document.getElementById("lost").hidden = answer !== null;
    if (answer === null) {
      close();
      return;
    }
    const { found, more } = answer;
    const note = found.length === 0 ? "No trial has these words in its name, driver or outcome."
      : more ? `${more} more: type more of a name, driver or outcome.` : "";
    list.replaceChildren(...found.map(entry), ...(note ? [replay.element("li", { class: "quiet" }, note)] : []));
    list.hidden = false;
  };
  const soon = () => {
    clearTimeout(waiting);
    waiting = setTimeout(look, PAUSE_MS);
  };
  const walk = (event, by) => {
    const stops = [field, ...list.querySelectorAll("button")];
    stops[Math.min(Math.max(stops.indexOf(event.target) + by, 0), stops.length - 1)].focus();
    event.preventDefault();
  };
  field.addEventListener("input", soon);
  field.addEventListener("focus", () => { field.select(); if (list.hidden) soon(); });
  form.addEventListener("focusout", (event) => { if (!form.contains(event.relatedTarget)) close(); });
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    list.querySelector("button")?.click();
  });
  form.addEventListener("keydown", (event) => {
    if (event.key === "ArrowDown" && !list.hidden) walk(event, 1);
    else if (event.key === "ArrowUp" && !list.hidden) walk(event, -1);
    else if (event.key === "Escape") { close(); document.activeElement.blur(); event.preventDefault(); }
    event.stopPropagation();
  });
  return { close, field };
};
