"use strict";
// Says so where the server does not answer any more; and what is not filtered by is not in the address.
(() => {
  const lost = (is) => {
    document.getElementById("lost").hidden = !is;
  };
  document.addEventListener("htmx:sendError", () => lost(true));
  // What is refused was answered.
  document.addEventListener("htmx:afterOnLoad", ({ detail }) => lost(detail.xhr.status >= 500));
  document.addEventListener("htmx:configRequest", ({ detail: { parameters } }) => {
    for (const [name, value] of Object.entries(parameters)) if (value === "") delete parameters[name];
  });
})();
