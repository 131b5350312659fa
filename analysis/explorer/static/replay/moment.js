"use strict";
// What a trial is like at one moment. Each file of the replay adds what it holds to this name.
window.replay = { SIDES: ["left", "right"] };
replay.sampled = (xs, ys, t) => {
  if (t <= xs[0]) return ys[0];
  const i = xs.findIndex((x) => x >= t);
  if (i < 0) return ys.at(-1);
  return ys[i - 1] + ((t - xs[i - 1]) / (xs[i] - xs[i - 1])) * (ys[i] - ys[i - 1]);
};
replay.inside = (run, t) => t <= run.end + 1e-9;
// Null where a vehicle is not: before its first sample, and after the end.
replay.value = (run, side, what, t) => {
  const samples = run.sides[side];
  if (!samples || !replay.inside(run, t) || t < samples.t[0] - 1e-9) return null;
  if (what !== "a") return replay.sampled(samples.t, samples[what], t);
  // A sample's acceleration is that of the step before it.
  return samples.a[samples.t.findIndex((x) => x >= t - 1e-9)] ?? samples.a.at(-1);
};
replay.headway = (run, t) => {
  const [left, right] = replay.SIDES.map((side) => replay.value(run, side, "x", t));
  return left === null || right === null ? null : left - right;
};
replay.minus = (value) => String(value).replace("-", "−");
replay.fixed = (value, digits) => (typeof value === "number" ? replay.minus(value.toFixed(digits)) : "–");
replay.element = (name, attributes, ...children) => {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
};
