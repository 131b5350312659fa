"use strict";
// Says so where the server does not answer any more, until it does again.
(() => {
  const lost = document.getElementById("lost");
  for (const name of ["htmx:sendError", "htmx:responseError"]) {
    document.addEventListener(name, () => { lost.hidden = false; });
  }
  document.addEventListener("htmx:afterOnLoad", (event) => { if (event.detail.successful) lost.hidden = true; });
})();
