"use strict";
// The clock: it plays, stops and is set, and whatever shows the moment is told.
replay.clock = (scene, { show, settled }) => {
  const SPEEDS = [0.25, 0.5, 1, 2, 4];
  const at = (id) => document.getElementById(id);
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  let speed = 1,
    last = 0;
  const tell = () => {
    at("scrub").max = scene.end;
    at("scrub").value = scene.now;
    at("scrub").setAttribute("aria-valuetext", `${scene.now.toFixed(1)} s`);
    at("clock").textContent = `${scene.now.toFixed(1)} s of ${scene.end.toFixed(1)} s`;
    const { sides } = scene.trial;
    at("now").textContent = replay.SIDES.filter((side) => sides[side])
      .map((side) => {
        const [v, x] = ["v", "x"].map((what) => replay.sampled(sides[side].t, sides[side][what], scene.now).toFixed(1));
        return `${side} ${v} m/s at ${x} m`;
      })
      .join("; ");
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
    at("play").setAttribute("aria-pressed", String(on));
    last = performance.now();
    if (on) requestAnimationFrame(tick);
    else settled();
  };
  const tick = (moment) => {
    if (!scene.playing) return;
    const passed = (speed * (moment - last)) / 1000;
    // Where the system asks for reduced motion, still pictures, two a second.
    if (!calm || passed >= 0.5 * speed) {
      last = moment;
      seek(scene.now + passed);
    }
    if (scene.now >= scene.end - 1e-9) play(false);
    else requestAnimationFrame(tick);
  };
  const setSpeed = (value) => {
    speed = value;
    at("speed").value = String(value);
  };
  at("scrub").min = scene.begin;
  at("scrub").addEventListener("input", (event) => seek(Number(event.target.value)));
  at("scrub").addEventListener("change", settled);
  at("play").addEventListener("click", () => play(!scene.playing));
  at("back").addEventListener("click", () => seek(scene.now - 0.1, true));
  at("on").addEventListener("click", () => seek(scene.now + 0.1, true));
  // What is chosen is done with: the keys are the replay's again.
  at("speed").addEventListener("change", (event) => {
    setSpeed(Number(event.target.value));
    event.target.blur();
  });
  return {
    seek,
    key: (event) => {
      const by = event.shiftKey ? 1 : 0.1;
      if (event.key === " " && !event.target.matches("a, button, summary")) play(!scene.playing);
      else if (event.key === "ArrowLeft") seek(scene.now - by, true);
      else if (event.key === "ArrowRight") seek(scene.now + by, true);
      else if (/^[1-5]$/.test(event.key)) setSpeed(SPEEDS[Number(event.key) - 1]);
      else return false;
      return true;
    },
  };
};
