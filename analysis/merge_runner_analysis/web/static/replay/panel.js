"use strict";
// The panel beside the replay: the decisions that drive now, or the one that was chosen.
replay.panel = (scene, ribbons) => {
  const { at, element } = replay;
  const box = at("panel"),
    shown = at("decision"),
    unread = [...shown.childNodes];
  let chosen = null,
    followed = "";

  // Who has scrolled down to read, or holds something in the panel, is left alone.
  const reading = () =>
    box.getBoundingClientRect().top < -8 || shown.contains(document.activeElement);
  const said = () => {
    at("follow").hidden = !chosen && !reading();
    box.ariaLive = scene.playing ? "off" : "polite";
  };
  const fill = (decisions) => {
    const parts = decisions.flatMap(({ panel, other }, i) => {
      panel.classList.toggle("brief", !chosen);
      if (chosen || !scene.ghost || decisions[i - 1]?.other === other) return [panel];
      return [element("h2", { class: "of" }, other ? `The other: ${scene.ghost.label}` : "This trial"), panel];
    });
    shown.replaceChildren(...(parts.length ? parts : unread));
  };
  const follow = () => {
    if (chosen || reading()) return said();
    const now = ribbons.current().filter(Boolean);
    const names = [...now.map(({ link }) => link.href), scene.ghost?.named].join();
    if (names !== followed) fill(now);
    followed = names;
    said();
  };
  const choose = (decision, scroll = false) => {
    chosen?.link.removeAttribute("aria-current");
    chosen = decision;
    followed = null;
    if (!chosen) return follow();
    chosen.link.ariaCurrent = "true";
    fill([chosen]);
    said();
    if (scroll && matchMedia("(max-width: 62rem)").matches) box.scrollIntoView();
  };
  const toReplay = () => at("trial").querySelector(".watch").scrollIntoView();
  addEventListener("scroll", said);
  at("to-replay").addEventListener("click", toReplay);
  return {
    follow,
    choose,
    free: () => {
      if (at("follow").hidden) return false;
      if (box.contains(document.activeElement)) document.activeElement.blur();
      if (box.getBoundingClientRect().top < 0) toReplay();
      choose(null);
      return true;
    },
    get chosen() {
      return chosen;
    },
  };
};
