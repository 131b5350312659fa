"use strict";
// Keys that work on every page, off while something is typed; and whether pages are light or dark.
(() => {
  // With AltGr some keyboards write brackets, and it looks like Ctrl and Alt.
  const command = (event) => (event.ctrlKey || event.metaKey || event.altKey) && !event.getModifierState("AltGraph");
  const typing = (target) => target.matches("input:not([type=range]), select, textarea");
  const help = document.getElementById("help");
  // Keys of a page are off while something is typed, and while a dialog is open.
  window.isElsewhere = (event) => command(event) || help.open || typing(event.target);
  const words = [...document.querySelectorAll("#page-words > div")].map((entry) => {
    const names = entry
      .querySelector("dt")
      .textContent.split(", ")
      .map((name) => name.replace(/[^\w ]/g, "\\$&"));
    return [entry, new RegExp(`(?<![\\w-])(${names.join("|")})(s|es)?(?![\\w-])`, "i")];
  });
  const explain = () => {
    const shown = document.getElementById("main").innerText;
    for (const [entry, name] of words) entry.hidden = !name.test(shown);
    help.showModal();
  };
  document.getElementById("help-button").addEventListener("click", explain);
  document.addEventListener("keydown", (event) => {
    const { key, target } = event;
    if (key === "Enter" && (event.ctrlKey || event.metaKey)) target.form?.requestSubmit();
    if (typing(target) && key === "Escape") target.blur();
    if (isElsewhere(event)) return;
    const search = document.getElementById("search");
    if (key === "?") explain();
    else if (key === "/" && search) search.focus();
    else if (key === "j") place.step(1);
    else if (key === "k") place.step(-1);
    else return;
    event.preventDefault();
  });

  const theme = document.getElementById("theme");
  const turn = () => {
    document.documentElement.dataset.theme = theme.value;
    dispatchEvent(new Event("themed"));
  };
  theme.value = localStorage.getItem("theme") ?? "";
  theme.addEventListener("change", () => {
    localStorage.setItem("theme", theme.value);
    turn();
  });
  turn();
})();
