"use strict";
// The track, from left to right; the left branch is above.
replay.track = (track, scene) => {
  const { svg, sampled, SIDES } = replay;
  const { trial } = scene,
    road = trial.track;
  const draw = (...made) => {
    const node = svg(...made);
    track.append(node);
    return node;
  };
  const sign = (side) => (side === "left" ? -1 : 1);
  const place = (side, s) =>
    s >= road.merge
      ? [road.merge * road.forward + s - road.merge, 0]
      : [s * road.forward, sign(side) * (road.merge - s) * road.lateral];
  const turned = (side, s) =>
    s >= road.merge ? 0 : (-sign(side) * Math.atan2(road.lateral, road.forward) * 180) / Math.PI;
  const moved = (side, s) => `translate(${place(side, s).join(" ")}) rotate(${turned(side, s)})`;
  const box = ({ length, width }) => ({ x: -length / 2, y: -width / 2, width: length, height: width });

  const [mergeX] = place("left", road.merge),
    [endX] = place("left", road.end);
  for (const kind of ["kerb", "lane"]) {
    for (const side of SIDES) draw("polyline", { class: kind, points: `${place(side, 0)} ${mergeX},0 ${endX},0` });
  }
  for (const side of SIDES) {
    draw("polyline", { class: "tunnel", points: `${place(side, 0)} ${place(side, road.tunnel)}` });
    // Towards the middle, where no vehicle drives over it.
    const y = side === "left" ? 6.4 : -4;
    draw("text", { class: "sign", y, transform: moved(side, road.tunnel / 2) }, `${side} tunnel`);
  }
  draw("polyline", { class: "merge", points: `${mergeX},-4 ${mergeX},4` });
  draw("text", { class: "sign", x: mergeX, y: -5.2 }, "merge point");

  // A vehicle as large as its trial has it; about this trial's, what its collision rule looks at.
  const judged = {
    euclid2d: ({ length }) => svg("circle", { class: "judged", r: length / 2 }),
    rectangle: (size) => svg("rect", { class: "judged", ...box(size) }),
    shared_lane: ({ length }) => svg("rect", { class: "judged", ...box({ length, width: 0.7 }) }),
  };
  const vehicles = ["ghost", "own"].flatMap((name) =>
    SIDES.map((side) => ({ name, side, group: draw("g", { class: `vehicle ${name} ${side}` }) })),
  );
  const build = (built, run) => {
    const { rule, length, width } = run.track;
    for (const { name, side, group } of vehicles.filter(({ name }) => name === built)) {
      const reach = (rule === "euclid2d" ? length : width) / 2;
      group.replaceChildren(
        svg("rect", { ...box(run.track), rx: 0.5 }),
        ...(name === "own" ? [judged[rule](run.track)] : []),
        svg("text", { y: side === "left" ? -reach - 0.8 : reach + 3 }, side[0].toUpperCase()),
      );
    }
  };
  build("own", trial);
  const crash = draw("g", { class: "crash" });
  if (trial.status === "collided") {
    const [[x, y], end] = SIDES.map((side) => place(side, trial.sides[side].x.at(-1)));
    crash.append(svg("polyline", { points: `${x},${y} ${end}` }), svg("text", { x, y: 13.5 }, "✸ crash"));
  }
  return {
    lay: (other) => build("ghost", other),
    show: () => {
      const { now, ghost } = scene;
      for (const { name, side, group } of vehicles) {
        const run = name === "own" ? trial : ghost,
          samples = run?.sides[side];
        group.setAttribute("display", samples ? "inline" : "none");
        if (!samples) continue;
        group.setAttribute("transform", moved(side, sampled(samples.t, samples.x, now)));
        group.classList.toggle("over", now > run.end + 1e-9);
      }
      const over = trial.status === "collided" && now >= trial.end - 1e-9;
      crash.setAttribute("display", over ? "inline" : "none");
      track.classList.toggle("collided", over);
    },
  };
};
