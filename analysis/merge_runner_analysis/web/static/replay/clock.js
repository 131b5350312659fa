"use strict";
// The clock: it plays, stops and is set, and whatever shows the moment is told.
replay.clock = (scene, { show, settled }) => {
  const { at, sampled } = replay;
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const toMerge = (x) => {
    const left = scene.trial.track.merge - x;
    return `${Math.abs(left).toFixed(1)} m ${left < 0 ? "past" : "to"} the merge point`;
  };
  let last = 0;
  const tell = () => {
    const now = `${scene.now.toFixed(1)} s`;
    at("scrub").max = scene.end;
    at("scrub").value = scene.now;
    at("scrub").ariaValueText = now;
    at("clock").textContent = `${now} of ${scene.end.toFixed(1)} s`;
    const sides = Object.entries(scene.trial.sides);
    const places = sides.map(([, { t, x }]) => sampled(t, x, scene.now));
    const said = sides.map(
      ([side, { t, v }], i) => `${side} ${sampled(t, v, scene.now).toFixed(1)} m/s, ${toMerge(places[i])}`,
    );
    if (sides.length > 1) {
      const [left, right] = places;
      said.push(`${left < right ? "right" : "left"} ${Math.abs(left - right).toFixed(1)} m ahead`);
    }
    at("now").textContent = said.join("; ");
    show();
  };
  const seek = (t, keep = false) => {
    scene.now = Math.min(Math.max(t, scene.begin), scene.end);
    tell();
    if (keep) settled();
  };
  const play = (on) => {
    if (on && scene.now >= scene.end - 1e-9) scene.now = scene.begin;
    scene.playing = on;
    at("play").textContent = on ? "Pause" : "Play";
    at("play").ariaPressed = String(on);
    last = performance.now();
    if (on) requestAnimationFrame(tick);
    else settled();
  };
  const tick = (moment) => {
    if (!scene.playing) return;
    const speed = Number(at("speed").value),
      passed = (speed * (moment - last)) / 1000;
    // Where the system asks for reduced motion, still pictures, two a second.
    if (!calm || passed >= 0.5 * speed) {
      last = moment;
      seek(scene.now + passed);
    }
    if (scene.now >= scene.end - 1e-9) play(false);
    else requestAnimationFrame(tick);
  };
  at("scrub").min = scene.begin;
  at("scrub").addEventListener("input", ({ target }) => seek(Number(target.value)));
  at("scrub").addEventListener("change", settled);
  at("play").addEventListener("click", () => play(!scene.playing));
  at("back").addEventListener("click", () => seek(scene.now - 0.1, true));
  at("on").addEventListener("click", () => seek(scene.now + 0.1, true));
  // What is chosen is done with: the keys are the replay's again.
  at("speed").addEventListener("change", ({ target }) => target.blur());
  return {
    seek,
    key: ({ key, shiftKey, target }) => {
      const by = shiftKey ? 1 : 0.1;
      if (key === " " && !target.matches("a, button, summary")) play(!scene.playing);
      else if (key === "ArrowLeft") seek(scene.now - by, true);
      else if (key === "ArrowRight") seek(scene.now + by, true);
      else if (/^[1-5]$/.test(key)) at("speed").selectedIndex = Number(key) - 1;
      else return false;
      return true;
    },
  };
};
