"use strict";
// Keys that work on every page; off while something is typed.
(() => {
  // With AltGr some keyboards write brackets, and it looks like Ctrl and Alt.
  window.isCommand = (event) => (event.ctrlKey || event.metaKey || event.altKey) && !event.getModifierState("AltGraph");
  const typing = (target) => target.matches("input:not([type=range]), select, textarea, [contenteditable]");
  const help = document.getElementById("help");
  document.getElementById("help-button").addEventListener("click", () => help.showModal());

  let chosen = -1;
  const choose = (step) => {
    const rows = [...document.querySelectorAll("[data-list] tbody tr")];
    if (!rows.length) return;
    rows[chosen]?.classList.remove("chosen");
    chosen = Math.min(Math.max(chosen + step, 0), rows.length - 1);
    rows[chosen].classList.add("chosen");
    rows[chosen].querySelector("a")?.focus({ preventScroll: true });
    rows[chosen].scrollIntoView({ block: "nearest" });
  };
  document.addEventListener("htmx:afterSwap", (event) => {
    // What a running sweep sends has the same rows; an answer has others.
    if (event.detail.xhr) chosen = -1;
    else document.querySelectorAll("[data-list] tbody tr")[chosen]?.classList.add("chosen");
  });

  document.addEventListener("keydown", (event) => {
    if (isCommand(event) || typing(event.target)) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    if (help.open) return;
    const search = document.getElementById("search");
    if (event.key === "?") help.showModal();
    else if (event.key === "/" && search) search.focus();
    else if (event.key === "j") choose(1);
    else if (event.key === "k") choose(-1);
    else return;
    event.preventDefault();
  });
})();
