"use strict";
// The link of a page, as it is now, into the clipboard.
(() => {
  const button = document.getElementById("copy-link");
  button.hidden = !navigator.clipboard;
  button.addEventListener("click", async () => {
    const said = button.textContent;
    try {
      await navigator.clipboard.writeText(location.href);
      button.textContent = "copied";
    } catch {
      button.textContent = "not allowed";
    }
    setTimeout(() => { button.textContent = said; }, 1500);
  });
})();
