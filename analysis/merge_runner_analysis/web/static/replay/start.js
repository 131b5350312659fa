"use strict";
// The replay of a trial: its parts, the keys, and the address, which tells the state.
window.startReplay = () => {
  const { at } = replay;
  if (at("trial")) place.lead();
  if (!at("replay-data")) return;
  const trial = JSON.parse(at("replay-data").textContent);
  const begin = Object.values(trial.sides)[0].t[0];
  const scene = {
    trial,
    begin,
    now: begin,
    ghost: null,
    recalled: false,
    playing: false,
    get end() {
      return Math.max(trial.end, scene.ghost?.end ?? 0);
    },
  };

  const remember = (push) => {
    if (push === null) return; // what the address says is being done
    const { chosen } = panel,
      wanted = new URL(location.href);
    const state = {
      t: scene.now > begin ? scene.now.toFixed(1) : "",
      side: chosen?.side,
      decision: chosen?.n,
      of: chosen?.other ? "other" : "",
      compare: scene.ghost?.named,
    };
    for (const [name, value] of Object.entries(state)) {
      if (value) wanted.searchParams.set(name, value);
      else wanted.searchParams.delete(name);
    }
    if (wanted.href !== location.href) history[push ? "pushState" : "replaceState"](null, "", wanted);
  };
  const recall = async () => {
    const asked = Object.fromEntries(new URLSearchParams(location.search));
    if ((asked.compare ?? "") !== (scene.ghost?.named ?? "")) await comparison.lay(asked.compare ?? "", null);
    scene.recalled = true;
    const decision = ribbons.find({ side: asked.side, n: asked.decision, other: asked.of === "other" }) ?? null;
    const t = parseFloat(asked.t || decision?.t);
    clock.seek(Number.isNaN(t) ? begin : t);
    panel.choose(decision);
  };

  const seek = (t) => clock.seek(t, true);
  const choose = (decision, scroll) => {
    if (!decision) return;
    panel.choose(decision, scroll);
    clock.seek(decision.t);
    remember(true);
  };
  const step = (by) => choose(ribbons.beside(panel.chosen, by));
  const free = () => panel.free() && (remember(true), true);
  const track = replay.track(at("track"), scene);
  const ribbons = replay.ribbons(scene);
  const charts = replay.charts(scene, ribbons, seek);
  const panel = replay.panel(scene, ribbons);
  const clock = replay.clock(scene, {
    show: () => {
      for (const part of [track, charts, ribbons]) part.show();
      if (scene.recalled) panel.follow(); // until then the address may name a decision
    },
    settled: () => remember(false),
  });
  const comparison = replay.comparison(scene, (push) => {
    if (scene.ghost) track.lay(scene.ghost);
    ribbons.lay(scene);
    if (panel.chosen?.other) panel.choose(null);
    charts.draw();
    clock.seek(scene.now);
    remember(push);
  });

  at("previous-decision").addEventListener("click", () => step(-1));
  at("next-decision").addEventListener("click", () => step(1));
  at("follow").addEventListener("click", free);
  at("trial").addEventListener("click", (event) => {
    const link = event.target.closest("a.decision, a.last");
    if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
    const { side, n } = link.dataset,
      all = ribbons.all();
    const decision =
      all.find((one) => one.link === link || one.panel === link.closest("article")) ??
      ribbons.find({ side, n, other: false });
    if (!decision) return;
    event.preventDefault();
    choose(decision, true);
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

  charts.draw();
  clock.seek(begin);
  recall();
};
startReplay();
