"use strict";
// The query box: Ctrl-Enter runs the query, and names of tables and columns can be put into it.
(() => {
  const box = document.getElementById("q");
  const running = document.getElementById("running");

  box.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" || !(event.ctrlKey || event.metaKey)) return;
    event.preventDefault();
    box.form.requestSubmit();
  });
  box.form.addEventListener("submit", () => { running.textContent = "running …"; });
  window.addEventListener("pageshow", () => { running.textContent = ""; });

  for (const name of document.querySelectorAll("[data-insert]")) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "name";
    button.textContent = name.dataset.insert;
    button.title = "put it into the query";
    button.addEventListener("click", () => {
      const before = box.value.slice(0, box.selectionStart);
      const space = /[\w)]$/.test(before) ? " " : "";
      box.setRangeText(space + name.dataset.insert, box.selectionStart, box.selectionEnd, "end");
      box.focus();
    });
    name.replaceWith(button);
  }
})();
