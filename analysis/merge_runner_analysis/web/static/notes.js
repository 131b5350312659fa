"use strict";
// Notes on a trial from the keyboard: of the decision that is chosen, or of the trial.
(() => {
  const form = document.getElementById("note");
  if (!form) return;
  const { text, side, decision } = form.elements;
  // While something is written, what it is about stays.
  form.addEventListener("focusin", () => {
    if (text.value) return;
    const chosen = document.querySelector("a.decision[aria-current]")?.dataset;
    side.value = chosen?.side ?? "";
    decision.value = chosen?.n ?? "";
    document.getElementById("note-about").textContent = chosen
      ? `on the ${chosen.side} decision ${chosen.n}`
      : "on the trial";
  });
  text.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" || event.shiftKey || event.isComposing) return;
    event.preventDefault();
    form.requestSubmit();
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const reply = await live(form.action, ["#noted"], {
      method: "POST",
      body: new URLSearchParams(new FormData(form)),
    });
    document.getElementById("note-said").textContent = reply?.ok
      ? "saved"
      : (await reply?.text()) || "not saved: no answer";
    if (!reply?.ok) return;
    form.reset();
    document.activeElement.blur();
  });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "n" || isElsewhere(event)) return;
    event.preventDefault();
    text.focus();
  });
})();
