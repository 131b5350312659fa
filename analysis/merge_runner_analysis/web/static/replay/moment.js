"use strict";
// What a trial is like at one moment. Each file of the replay adds what it holds to this name.
window.replay = { SIDES: ["left", "right"], at: (id) => document.getElementById(id) };
replay.sampled = (xs, ys, t) => {
  if (t <= xs[0]) return ys[0];
  const i = xs.findIndex((x) => x >= t);
  if (i < 0) return ys.at(-1);
  return ys[i - 1] + ((t - xs[i - 1]) / (xs[i] - xs[i - 1])) * (ys[i] - ys[i - 1]);
};
replay.minus = (value) => String(value).replace("-", "−");
replay.made =
  (namespace) =>
  (name, attributes, ...children) => {
    const node = document.createElementNS(`http://www.w3.org/${namespace}`, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  };
replay.element = replay.made("1999/xhtml");
replay.svg = replay.made("2000/svg");
