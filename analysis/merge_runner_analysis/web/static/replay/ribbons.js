"use strict";
// The decisions of this trial and of the other one, each with its link in a ribbon and its panel.
replay.ribbons = (scene) => {
  const { at, SIDES, element } = replay;
  // Panels stand in the order of the ribbons.
  const read = (place, run, text, other) => {
    const holder = element("template", {});
    holder.innerHTML = text;
    label(holder.content);
    const panels = [...holder.content.children];
    return [...at(place).querySelectorAll("a.decision")].map((link, i) => {
      const { side, n } = link.dataset,
        t = Number(link.dataset.t),
        usual = t + run.every[side];
      return { link, side, n, t, usual, until: Math.min(usual, run.end), other, panel: panels[i] };
    });
  };
  const own = read("ribbons", scene.trial, at("panels").textContent, false);
  const ordered = [...own].sort((a, b) => a.t - b.t || a.side.localeCompare(b.side));
  let others = [];
  const all = () => [...own, ...others];
  const begun = ({ t }) => t <= scene.now + 1e-9;
  const drives = (one) => begun(one) && scene.now < one.until - 1e-9;
  return {
    all,
    lay: ({ ghost }) => {
      at("other-ribbons").innerHTML = ghost?.ribbons ?? "";
      others = ghost ? read("other-ribbons", ghost, ghost.panels, true) : [];
    },
    show: () => {
      for (const one of all()) one.link.classList.toggle("now", drives(one));
    },
    find: ({ side, n, other }) => all().find((one) => one.side === side && one.n === n && one.other === other),
    // Of each driver the one that drives now; after the end, the last.
    current: () =>
      [own, others].flatMap((run) => SIDES.map((side) => run.findLast((one) => one.side === side && begun(one)))),
    // From the one that is chosen, or where the clock has left it, from the clock.
    beside: (chosen, by) => {
      let next = ordered.indexOf(chosen) + by;
      if (!chosen || chosen.other || !drives(chosen)) {
        next = by > 0 ? ordered.findIndex(({ t }) => t >= scene.now - 1e-9) : ordered.findLastIndex(begun);
        if (next < 0) next = by > 0 ? ordered.length - 1 : 0;
      }
      return ordered[Math.min(Math.max(next, 0), ordered.length - 1)];
    },
  };
};
