"use strict";
// The panel beside the replay: the decisions that drive now, or the one that was chosen.
replay.panel = (scene, ribbons) => {
  const PAUSE_MS = 120; // Between two looks at what drives now: a slider passes many decisions.
  const at = (id) => document.getElementById(id);
  const box = at("panel"),
    shown = at("decision"),
    narrow = matchMedia("(max-width: 62rem)");
  const kept = new Map();
  let chosen = null,
    waiting = 0,
    followed = null,
    standing = null;

  const read = (link) => {
    if (!kept.has(link)) {
      const asked = explorer.panel(link, ribbons.ofOther(link) ? scene.ghost : null);
      kept.set(link, asked);
      asked.catch(() => kept.delete(link));
    }
    return kept.get(link);
  };
  const lost = () => {
    at("lost").hidden = false;
    shown.replaceChildren();
    delete shown.dataset.of;
    followed = null;
  };
  // Who has scrolled down to read, or holds something in the panel, is left alone.
  const reading = () =>
    box.scrollTop > 8 ||
    box.getBoundingClientRect().top < -8 ||
    (box !== document.activeElement &&
      box.contains(document.activeElement) &&
      !document.activeElement.closest(".panel-bar"));
  const said = () => {
    const still = chosen !== null || (followed !== null && reading());
    at("follow").hidden = !still;
    box.setAttribute("aria-live", scene.playing ? "off" : "polite");
  };
  const heading = (links, other) =>
    scene.ghost && links.some((link) => ribbons.ofOther(link) === other)
      ? [replay.element("h2", { class: "of" }, other ? `The other: ${scene.ghost.label}` : "This trial")]
      : [];
  const brief = (html, link) => {
    const whole = replay.element(
      "a",
      { href: link.href, class: "last", "data-side": link.dataset.side, "data-n": link.dataset.n },
      "what it was told, and all the rest",
    );
    if (ribbons.ofOther(link)) whole.dataset.other = "true";
    const made = replay.element("div", { class: "brief" });
    made.innerHTML = html;
    made.append(replay.element("p", { class: "small" }, whole));
    return made;
  };
  const look = async () => {
    waiting = 0;
    if (chosen || reading() || scene.now === standing) return said();
    const begun = scene.now > scene.begin + 1e-9 || scene.ghost;
    const links = begun ? ribbons.current() : [];
    const names =
      links.map((link) => link.dataset.panel || `${link.dataset.side}/${link.dataset.n}`).join(" ") +
      Boolean(scene.ghost);
    if (names === followed) return said();
    followed = names;
    let pages;
    try {
      pages = await Promise.all(links.map(read));
    } catch {
      return lost();
    }
    if (chosen || reading() || followed !== names) return said();
    at("lost").hidden = true;
    delete shown.dataset.of;
    if (!links.length) shown.innerHTML = at("unread").innerHTML;
    else {
      shown.replaceChildren(
        ...[false, true].flatMap((other) => [
          ...heading(links, other),
          ...links.flatMap((link, i) => (ribbons.ofOther(link) === other ? [brief(pages[i], link)] : [])),
        ]),
      );
    }
    said();
  };
  const follow = () => {
    if (!chosen) waiting ||= setTimeout(look, PAUSE_MS);
  };
  const choose = async (link, { scroll = false } = {}) => {
    ribbons.choose(link);
    chosen = link;
    followed = standing = null;
    if (!link) return look();
    said();
    try {
      const html = await read(link);
      if (chosen !== link) return;
      at("lost").hidden = true;
      if (shown.dataset.of !== link.href) shown.innerHTML = html;
      shown.dataset.of = link.href;
      box.scrollTop = 0;
      if (scroll && narrow.matches) box.scrollIntoView({ block: "start" });
    } catch {
      if (chosen === link) lost();
    }
  };
  const free = () => {
    if (!chosen && at("follow").hidden) return false;
    if (box.contains(document.activeElement)) document.activeElement.blur();
    box.scrollTop = 0;
    if (box.getBoundingClientRect().top < 0) at("track").scrollIntoView({ block: "start" });
    choose(null);
    return true;
  };
  box.addEventListener("scroll", said);
  at("to-replay").addEventListener("click", () => at("track").scrollIntoView({ block: "start" }));
  // What the page came with: of a decision, or that there is no such one.
  const come = (link) => {
    if (link && shown.querySelector(".decision-panel")) {
      kept.set(link, Promise.resolve(shown.innerHTML));
      shown.dataset.of = link.href;
    }
    if (!link) standing = scene.now;
  };
  return {
    follow,
    choose,
    free,
    come,
    get chosen() {
      return chosen;
    },
  };
};
