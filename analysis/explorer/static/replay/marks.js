"use strict";
// The moments that matter: who merges, a collision, whatever else the page was told of.
replay.marks = (scene, seek) => {
  const at = (id) => document.getElementById(id);
  const symbol = (mark) => {
    const text = `${{ merge: "▾", collision: "✸" }[mark.kind] ?? "◆"}${mark.side ? mark.side[0].toUpperCase() : ""}`;
    return mark.other ? `(${text})` : text;
  };
  const named = (mark) => `moment ${mark.kind.replaceAll(" ", "-")} ${mark.side}${mark.other ? " other" : ""}`;
  const words = (mark) => `${mark.t.toFixed(1)} s: ${mark.other ? "the other trial: " : ""}${mark.text}`;
  const all = () =>
    [...scene.trial.marks, ...(scene.ghost?.marks ?? []).map((mark) => ({ ...mark, other: true }))].sort(
      (a, b) => a.t - b.t,
    );
  // In three rows, so that moments close to each other do not cover each other.
  const lines = (place) =>
    all().map((mark, i) => {
      const line = replay.element(
        "span",
        { class: named(mark), title: words(mark) },
        replay.element("b", { class: `row${i % 3}` }, symbol(mark)),
      );
      line.style.left = place(mark.t);
      return line;
    });
  return {
    onto: (plot) => {
      for (const old of plot.over.querySelectorAll(".moment")) old.remove();
      plot.over.append(...lines((t) => `${plot.valToPos(t, "x")}px`));
    },
    list: () => {
      const part = (t) => (t - scene.begin) / (scene.end - scene.begin || 1);
      // A slider's handle is 16 px wide, and its middle tells the time.
      at("ticks").replaceChildren(...lines((t) => `calc(8px + ${part(t)} * (100% - 16px))`));
      at("moments").replaceChildren(
        ...all().map((mark) => {
          const button = replay.element(
            "button",
            { type: "button", class: named(mark) },
            replay.element("b", { "aria-hidden": "true" }, symbol(mark)),
            ` ${words(mark)}`,
          );
          button.addEventListener("click", () => seek(mark.t));
          return replay.element("li", {}, button);
        }),
      );
    },
  };
};
