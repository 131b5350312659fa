"use strict";
// Ribbons of decisions under the track, on the axis of the charts: this trial's, and the other's.
replay.ribbons = (scene) => {
  const at = (id) => document.getElementById(id);
  const read = () => [...document.querySelectorAll("a.decision")];
  let links = read();
  const ofOther = (link) => link.closest("#other-ribbons") !== null;
  const run = (link) => (ofOther(link) ? scene.ghost : scene.trial);
  const begins = (link) => Number(link.dataset.t);
  const until = (link) => Math.min(begins(link) + run(link).every[link.dataset.side], run(link).end);
  const drives = (link) => begins(link) <= scene.now + 1e-9 && scene.now < until(link) - 1e-9;
  const ordered = () =>
    links
      .filter((link) => !ofOther(link))
      .sort((a, b) => a.dataset.t - b.dataset.t || a.dataset.side.localeCompare(b.dataset.side));
  return {
    ofOther,
    run,
    drives,
    begins,
    lay: (ribbons) => {
      at("other-ribbons").innerHTML = ribbons;
      links = read();
    },
    place: (plot) => {
      if (!plot) return;
      const box = plot.over.getBoundingClientRect(),
        scale = (t) => plot.valToPos(t, "x");
      for (const holder of document.querySelectorAll(".ribbons")) {
        const offset = box.left - holder.getBoundingClientRect().left;
        for (const link of holder.querySelectorAll("a.decision")) {
          link.parentElement.style.left = `${offset + scale(begins(link))}px`;
          const [from, usual, to] = [begins(link), begins(link) + run(link).every[link.dataset.side], until(link)].map(
            scale,
          );
          // The last one may be short: it has its letter still, but no more room than the others.
          link.parentElement.style.width = `${Math.max(Math.min(14, usual - from - 1), to - from - 2)}px`;
        }
        holder.classList.add("placed");
      }
    },
    show: () => {
      for (const link of links) link.classList.toggle("now", drives(link));
    },
    choose: (chosen) => {
      for (const link of links) link.removeAttribute("aria-current");
      chosen?.setAttribute("aria-current", "true");
    },
    find: ({ side, n, other }) =>
      links.find((link) => link.dataset.side === side && link.dataset.n === n && ofOther(link) === Boolean(other)),
    // Of each driver the one that drives now; after the end, the last.
    current: () =>
      [false, true]
        .flatMap((other) =>
          replay.SIDES.map((side) =>
            links.findLast(
              (link) => ofOther(link) === other && link.dataset.side === side && begins(link) <= scene.now + 1e-9,
            ),
          ),
        )
        .filter(Boolean),
    // From the one that is chosen, or where the clock has left it, from the clock.
    beside: (chosen, by) => {
      const every = ordered();
      let next = every.indexOf(chosen) + by;
      if (!chosen || ofOther(chosen) || !drives(chosen)) {
        next =
          by > 0
            ? every.findIndex((link) => begins(link) >= scene.now - 1e-9)
            : every.findLastIndex((link) => begins(link) <= scene.now + 1e-9);
        if (next < 0) next = by > 0 ? every.length - 1 : 0;
      }
      return every[Math.min(Math.max(next, 0), every.length - 1)];
    },
  };
};
