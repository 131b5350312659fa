"use strict";
// Keys that work on every page, off while something is typed; and whether pages are light or dark.
(() => {
  // With AltGr some keyboards write brackets, and it looks like Ctrl and Alt.
  const command = (event) => (event.ctrlKey || event.metaKey || event.altKey) && !event.getModifierState("AltGraph");
  const typing = (target) => target.matches("input:not([type=range]), select, textarea");
  const help = document.getElementById("help");
  // Keys of a page are off while something is typed, and while the help is open.
  window.isElsewhere = (event) => command(event) || help.matches(":popover-open") || typing(event.target);
  document.addEventListener("keydown", (event) => {
    const { key, target } = event;
    if (key === "Enter" && (event.ctrlKey || event.metaKey)) target.form?.requestSubmit();
    if (typing(target) && key === "Escape") target.blur();
    if (isElsewhere(event)) return;
    const search = document.getElementById("search");
    if (key === "?") help.showPopover();
    else if (key === "/" && search) search.focus();
    else if (key === "j") place.step("next");
    else if (key === "k") place.step("previous");
    else return;
    event.preventDefault();
  });

  const theme = document.getElementById("theme");
  const turn = () => {
    document.documentElement.dataset.theme = theme.value;
  };
  theme.value = localStorage.getItem("theme") ?? "";
  theme.addEventListener("change", () => {
    localStorage.setItem("theme", theme.value);
    turn();
  });
  turn();
})();
