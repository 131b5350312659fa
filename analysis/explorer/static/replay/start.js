"use strict";
// The replay of a trial: its parts, the keys, and the address, which tells the state.
// Where panels and other trials come from; a page without a server holds them.
replay.held = (link, part) =>
  part.querySelector(`template[data-of="${link.dataset.side}/${link.dataset.n}"]`)?.innerHTML;
window.explorer ??= (() => {
  const answer = async (address) => {
    const reply = await fetch(address);
    if (!reply.ok) throw new Error(`${reply.status}`);
    return reply;
  };
  const other = async (asked) =>
    (await answer(`${document.getElementById("trial").dataset.others}&${new URLSearchParams(asked)}`)).json();
  return {
    panel: async (link) => replay.held(link, document) ?? (await answer(link.dataset.panel)).text(),
    data: (compare) => other({ compare }),
    search: (q) => other({ q }),
    offer: (offer) => other({ offer }),
  };
})();
window.startReplay = () => {
  const at = (id) => document.getElementById(id);
  if (at("trial")) place.lead();
  const holder = at("replay-data");
  if (!holder) return;
  const trial = JSON.parse(holder.textContent);
  const begin = Object.values(trial.sides)[0].t[0];
  const scene = {
    trial,
    begin,
    now: begin,
    ghost: null,
    playing: false,
    get end() {
      return Math.max(trial.end, scene.ghost?.end ?? 0);
    },
  };

  // ---- the address tells the state

  const address = () => new URL(location.href);
  const remember = (push) => {
    if (push === null) return; // what the address says is being done
    const { chosen } = panel,
      wanted = address();
    const state = {
      t: scene.now > begin ? scene.now.toFixed(1) : "",
      side: chosen?.dataset.side,
      decision: chosen?.dataset.n,
      of: chosen && ribbons.ofOther(chosen) ? "other" : "",
      compare: scene.ghost?.named,
    };
    for (const [name, value] of Object.entries(state)) {
      if (value) wanted.searchParams.set(name, value);
      else wanted.searchParams.delete(name);
    }
    if (wanted.href !== location.href) history[push ? "pushState" : "replaceState"](null, "", wanted);
  };
  const recall = async () => {
    const asked = address().searchParams;
    if ((asked.get("compare") ?? "") !== (scene.ghost?.named ?? ""))
      await comparison.lay(asked.get("compare") ?? "", null);
    const link = ribbons.find({ side: asked.get("side"), n: asked.get("decision"), other: asked.get("of") });
    if (asked.has("t")) clock.seek(Number(asked.get("t")) || begin);
    else clock.seek(link ? ribbons.begins(link) : begin);
    // Of a decision that is not there the page says so already.
    if (link || !asked.has("decision")) panel.choose(link ?? null);
    else panel.come(null);
  };

  // ---- the parts

  const choose = (link, { scroll = false } = {}) => {
    if (!link) return;
    panel.choose(link, { scroll });
    clock.seek(ribbons.begins(link));
    remember(true);
  };
  const step = (by) => choose(ribbons.beside(panel.chosen, by));
  const free = () => panel.free() && (remember(true), true);
  const track = replay.track(at("track"), scene);
  const ribbons = replay.ribbons(scene);
  const marks = replay.marks(scene, (t) => clock.seek(t, true));
  const charts = replay.charts(scene, { seek: (t) => clock.seek(t, true), marks, placed: ribbons.place });
  const panel = replay.panel(scene, ribbons);
  const clock = replay.clock(scene, {
    show: () => {
      for (const part of [track, charts, ribbons]) part.show();
      panel.follow();
    },
    settled: () => remember(false),
  });
  const comparison = replay.comparison(scene, {
    changed: (push) => {
      if (scene.ghost) track.lay(scene.ghost);
      ribbons.lay(scene.ghost?.ribbons ?? "");
      if (panel.chosen && !panel.chosen.isConnected) panel.choose(null);
      charts.draw();
      marks.list();
      clock.seek(scene.now);
      remember(push);
    },
  });

  // ---- hands

  at("previous-decision").addEventListener("click", () => step(-1));
  at("next-decision").addEventListener("click", () => step(1));
  at("follow").addEventListener("click", free);
  at("trial").addEventListener("click", (event) => {
    const asked = event.target.closest("a.decision, a.last");
    const link = asked && ribbons.find({ ...asked.dataset, other: asked.dataset.other || ribbons.ofOther(asked) });
    if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    choose(link, { scroll: true });
  });
  addEventListener("popstate", recall);
  document.addEventListener("keydown", (event) => {
    if (isElsewhere(event)) return;
    if (clock.key(event)) event.preventDefault();
    else if (event.key === "]") step(1);
    else if (event.key === "[") step(-1);
    else if (event.key === "c" && at("compare")) {
      at("compare").focus();
      event.preventDefault();
    } else if (event.key === "Escape" && !free() && place.back()) location.href = place.back();
  });

  const first = address().searchParams;
  const come = ribbons.find({ side: first.get("side"), n: first.get("decision") });
  if (come && !first.get("of")) panel.come(come);
  charts.draw();
  marks.list();
  recall();
};
startReplay();
