"use strict";
// The track, from left to right; the left branch is above.
replay.track = (track, scene) => {
  const { trial } = scene,
    road = trial.track;
  const draw = (name, attributes, parent, text) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text) made.textContent = text;
    parent.append(made);
    return made;
  };
  const sign = (side) => (side === "left" ? -1 : 1);
  const place = (side, s) =>
    s >= road.merge
      ? [road.merge * road.forward + s - road.merge, 0]
      : [s * road.forward, sign(side) * (road.merge - s) * road.lateral];
  const turned = (side, s) =>
    s >= road.merge ? 0 : (-sign(side) * Math.atan2(road.lateral, road.forward) * 180) / Math.PI;

  const vehicles = {};
  // A vehicle as large as its trial has it; about this trial's, what its collision rule looks at.
  const judged = {
    euclid2d: ({ length }) => ["circle", { r: length / 2 }],
    rectangle: ({ length, width }) => ["rect", { x: -length / 2, y: -width / 2, width: length, height: width }],
    shared_lane: ({ length }) => ["rect", { x: -length / 2, y: -0.35, width: length, height: 0.7 }],
  };
  const build = (name, run) => {
    const { length, width, rule } = run.track;
    for (const side of replay.SIDES) {
      const group = vehicles[name][side];
      group.replaceChildren();
      draw("rect", { x: -length / 2, y: -width / 2, width: length, height: width, rx: 0.5 }, group);
      if (name === "own") {
        const [shape, size] = judged[rule](run.track);
        draw(shape, { class: "judged", ...size }, group);
      }
      const reach = (rule === "euclid2d" ? length : width) / 2;
      draw("text", { x: 0, y: side === "left" ? -reach - 0.8 : reach + 3 }, group, side === "left" ? "L" : "R");
    }
  };
  const [mergeX] = place("left", road.merge),
    [endX] = place("left", road.end);
  for (const kind of ["kerb", "lane"]) {
    for (const side of replay.SIDES) {
      const [x, y] = place(side, 0);
      draw("polyline", { class: kind, points: `${x},${y} ${mergeX},0 ${endX},0` }, track);
    }
  }
  for (const side of replay.SIDES) {
    const [x0, y0] = place(side, 0),
      [x1, y1] = place(side, road.tunnel),
      middle = road.tunnel / 2;
    draw("line", { class: "tunnel", x1: x0, y1: y0, x2: x1, y2: y1 }, track);
    draw("text", { class: "sign exit", x: x1 - 2, y: y1 + (side === "left" ? -5.8 : 8) }, track, "tunnel exit");
    // Towards the middle, where no vehicle drives over it.
    draw(
      "text",
      {
        class: "sign",
        y: side === "left" ? 6.4 : -4,
        transform: `translate(${place(side, middle).join(" ")}) rotate(${turned(side, middle)})`,
      },
      track,
      `${side} tunnel`,
    );
  }
  draw("line", { class: "merge", x1: mergeX, y1: -4, x2: mergeX, y2: 4 }, track);
  draw("text", { class: "sign", x: mergeX, y: -5.2 }, track, "merge point");
  draw("text", { class: "sign", x: endX - 5, y: -3.4 }, track, "end");
  for (const name of ["ghost", "own"]) {
    vehicles[name] = {};
    for (const side of replay.SIDES) vehicles[name][side] = draw("g", { class: `vehicle ${name} ${side}` }, track);
  }
  build("own", trial);
  const crash = draw("g", { class: "crash" }, track);
  const between = draw("line", {}, crash),
    crashed = draw("text", { y: 13.5 }, crash);

  const move = (name, run) => {
    for (const side of replay.SIDES) {
      const group = vehicles[name][side],
        samples = run?.sides[side];
      group.toggleAttribute("hidden", !samples);
      group.setAttribute("display", samples ? "inline" : "none");
      if (!samples) continue;
      const s = replay.sampled(samples.t, samples.x, scene.now),
        [x, y] = place(side, s);
      group.setAttribute(
        "transform",
        `translate(${x.toFixed(2)} ${y.toFixed(2)}) rotate(${turned(side, s).toFixed(1)})`,
      );
      group.classList.toggle("over", !replay.inside(run, scene.now));
    }
  };
  const collide = () => {
    const [left, right] = replay.SIDES.map((side) => trial.sides[side].x.at(-1));
    const [[x1, y1], [x2, y2]] = [place("left", left), place("right", right)];
    for (const [name, value] of Object.entries({ x1, y1, x2, y2 })) between.setAttribute(name, value);
    // Beside the signs, and within the picture.
    crashed.setAttribute("x", Math.min(Math.max((x1 + x2) / 2, mergeX - 3), mergeX + 15));
    crashed.textContent = `✸ collision, ${
      {
        euclid2d: `${Math.hypot(x1 - x2, y1 - y2).toFixed(1)} m between the centres`,
        rectangle: "the outlines overlap",
        shared_lane: `${Math.abs(left - right).toFixed(1)} m apart along the road`,
      }[road.rule]
    }`;
  };
  return {
    lay: (other) => build("ghost", other),
    show: () => {
      move("own", trial);
      move("ghost", scene.ghost);
      const over = trial.status === "collided" && scene.now >= trial.end - 1e-9;
      crash.setAttribute("display", over ? "inline" : "none");
      track.classList.toggle("collided", over);
      const places = Object.values(trial.sides).map((samples) => replay.sampled(samples.t, samples.x, scene.now));
      track.classList.toggle("unjudged", road.rule === "shared_lane" && Math.max(...places) < road.merge);
      if (over) collide();
    },
  };
};
