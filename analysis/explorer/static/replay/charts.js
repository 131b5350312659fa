"use strict";
// Charts on one time axis, and a line in each for the clock.
replay.charts = (scene, { seek, marks, placed }) => {
  const HEIGHT = 130,
    PAPER = 660; // of a chart, and the width of one in print, in pixels
  const holder = document.getElementById("charts");
  const { trial } = scene,
    road = trial.track;
  // Read anew at each drawing: the page may turn from light to dark, and paper is light.
  const colour = (name) => {
    holder.style.color = `var(--${name})`;
    const computed = getComputedStyle(holder).color;
    holder.style.color = "";
    return computed;
  };
  const plots = [];
  let times = [],
    width = 0;

  const pointed = (plot) => plot.cursor.left >= 0 && plot.cursor.idx !== null;
  // The legend tells the moment that is pointed at, or else that of the clock.
  const line = (label, stroke, value, extra) => ({
    value,
    series: {
      label,
      stroke,
      width: 1.6,
      points: { show: false },
      value: (plot, v) => replay.fixed(pointed(plot) ? v : value(scene.now), 2),
      ...extra,
    },
  });
  const nearest = () =>
    times.reduce((best, t, i) => (Math.abs(t - scene.now) < Math.abs(times[best] - scene.now) ? i : best), 0);
  const show = () => {
    const idx = nearest();
    for (const plot of plots) {
      plot.playhead.style.transform = `translateX(${plot.valToPos(scene.now, "x")}px)`;
      if (!pointed(plot)) plot.setLegend({ idx });
    }
  };
  const fit = () => {
    for (const plot of plots) marks.onto(plot);
    placed(plots[0]);
    show();
  };
  const clickable = (plot) => {
    plot.over.addEventListener("click", (event) => {
      seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    });
    plot.over.addEventListener("mouseleave", show);
  };
  const chart = (id, heading, unit, lines, { scales, ...extra } = {}) => {
    const axis = { stroke: colour("ink"), grid: { stroke: colour("line") }, ticks: { stroke: colour("line") } };
    const plot = new uPlot(
      {
        title: heading,
        width: width || holder.clientWidth,
        height: HEIGHT,
        legend: { live: true },
        cursor: { sync: { key: "replay" }, drag: { x: false, y: false } },
        scales: { x: { time: false }, ...scales },
        axes: [
          { ...axis, size: 24, gap: 2, values: (_, ticks) => ticks.map((t) => `${t} s`) },
          { ...axis, size: 54, label: unit, labelSize: 18, labelGap: 0, values: (_, ticks) => ticks.map(replay.minus) },
        ],
        series: [
          { label: "t", value: (u, v) => `${(pointed(u) ? v : scene.now).toFixed(1)} s` },
          ...lines.map((one) => one.series),
        ],
        hooks: { ready: [clickable, fit] },
        ...extra,
      },
      [times, ...lines.map((one) => times.map(one.value))],
      document.getElementById(id),
    );
    plot.playhead = replay.element("div", { class: "playhead" });
    plot.over.append(plot.playhead);
    plots.push(plot);
  };
  const dashed = { dash: [4, 4], width: 1.2 };
  const runs = () => [[trial, "", {}], ...(scene.ghost ? [[scene.ghost, ", other", dashed]] : [])];
  const both = (id, heading, unit, what, extra, options) =>
    chart(
      id,
      heading,
      unit,
      runs().flatMap(([run, note, style]) =>
        replay.SIDES.map((side) =>
          line(`${side}${note}`, colour(side), (t) => replay.value(run, side, what, t), { ...style, ...extra }),
        ),
      ),
      options,
    );
  // Where no headway is a collision, the band has no width.
  const bound = (t) => {
    if (!replay.inside(trial, t) || !trial.bounds.length) return null;
    const own = Object.values(trial.sides)[0].t,
      i = own.findIndex((x) => x >= t - 1e-9);
    return trial.bounds[i < 0 ? own.length - 1 : i] ?? 0;
  };
  const draw = () => {
    for (const plot of plots.splice(0)) plot.destroy();
    const own = Object.values(trial.sides)[0].t;
    // With a second trial the time goes on to the end of the later one.
    times = [...own, ...(scene.ghost ? Object.values(scene.ghost.sides)[0].t : []).filter((t) => t > trial.end + 1e-9)];
    both("chart-v", "Velocity", "m/s", "v", {});
    both(
      "chart-a",
      "Acceleration",
      "m/s²",
      "a",
      { paths: uPlot.paths.stepped({ align: -1 }) },
      { scales: { y: { range: (_, low, high) => [Math.min(low, -road.hardest), Math.max(high, road.hardest)] } } },
    );
    const edge = { width: 0.5 };
    const [first, ...others] = runs().map(([run, note, style]) =>
      line(`headway${note}`, colour("ink"), (t) => replay.headway(run, t), style),
    );
    chart(
      "chart-h",
      "Headway: how far the left vehicle is ahead; shaded: collision",
      "m",
      [
        first,
        line("collision below", colour("edge"), bound, edge),
        line("and above", colour("edge"), (t) => (bound(t) === null ? null : -bound(t)), edge),
        ...others,
      ],
      { bands: [{ series: [2, 3], fill: colour("collision") }] },
    );
    fit();
  };
  const resize = (wanted) => {
    if (wanted === width) return;
    width = wanted;
    for (const plot of plots) plot.setSize({ width, height: HEIGHT });
    if (plots.length) fit();
  };
  const paper = (on) => {
    document.documentElement.classList.toggle("paper", on);
    resize(on ? PAPER : holder.clientWidth);
    draw();
  };
  new ResizeObserver(() => resize(holder.clientWidth)).observe(holder);
  addEventListener("beforeprint", () => paper(true));
  addEventListener("afterprint", () => paper(false));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  addEventListener("themed", draw);
  return { draw, show };
};
