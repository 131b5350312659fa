"use strict";
// Keys that work on every page; off while something is typed.
(() => {
  // With AltGr some keyboards write brackets, and it looks like Ctrl and Alt.
  window.isCommand = (event) => (event.ctrlKey || event.metaKey || event.altKey) && !event.getModifierState("AltGraph");
  const typing = (target) => target.matches("input:not([type=range]), select, textarea, [contenteditable]");
  const help = document.getElementById("help");
  // Keys of a page are off while something is typed, and while a dialog is open.
  window.isElsewhere = (event) => isCommand(event) || help.open || typing(event.target);
  const words = [...document.querySelectorAll("#page-words > div")].map((entry) => {
    const names = entry.querySelector("dt").textContent.split(", ").map((name) => name.replace(/[^\w ]/g, "\\$&"));
    return [entry, new RegExp(`(?<![\\w-])(${names.join("|")})(s|es)?(?![\\w-])`, "i")];
  });
  const explain = () => {
    const said = document.getElementById("main").innerText;
    for (const [entry, name] of words) entry.hidden = !name.test(said);
    help.showModal();
  };
  document.getElementById("help-button").addEventListener("click", explain);

  document.addEventListener("keydown", (event) => {
    if (isCommand(event) || typing(event.target)) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    if (help.open) return;
    const search = document.getElementById("search");
    if (event.key === "?") explain();
    else if (event.key === "/" && search) search.focus();
    else if (event.key === "j") place.step(1);
    else if (event.key === "k") place.step(-1);
    else return;
    event.preventDefault();
  });
})();
