"use strict";
// Says so where the server does not answer any more; and what is not filtered by is not in the address.
(() => {
  const lost = document.getElementById("lost");
  document.addEventListener("htmx:sendError", () => {
    lost.hidden = false;
  });
  // What is refused was answered.
  document.addEventListener("htmx:responseError", (event) => {
    if (event.detail.xhr.status >= 500) lost.hidden = false;
  });
  document.addEventListener("htmx:afterOnLoad", (event) => {
    if (event.detail.successful) lost.hidden = true;
  });
  document.addEventListener("htmx:configRequest", ({ detail: { parameters } }) => {
    for (const [name, value] of Object.entries(parameters)) if (value === "") delete parameters[name];
  });
})();
