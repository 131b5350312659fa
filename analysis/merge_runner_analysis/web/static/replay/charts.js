"use strict";
// Ribbons and charts on one axis of time, with lines at the moments that matter and at the clock.
replay.charts = (scene, ribbons, seek) => {
  const { at, element, svg, minus, SIDES } = replay;
  const { trial } = scene;
  const part = (t) => (100 * (t - scene.begin)) / (scene.end - scene.begin || 1);
  const percent = (t) => `${part(t)}%`;
  const ticks = (low, high, most) => {
    const least = (high - low) / most,
      size = 10 ** Math.floor(Math.log10(least));
    const step = [1, 2, 5, 10].find((times) => times * size >= least) * size;
    const first = Math.ceil(low / step);
    return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, i) => +((first + i) * step).toFixed(6));
  };
  // Lines are [class, [[time, value], ...]]; the axis holds them, and these values.
  const chart = (id, lines, ...held) => {
    const values = [...held, ...lines.flatMap(([, points]) => points.map(([, value]) => value))];
    const low = Math.min(...values),
      high = Math.max(...values, low + 0.1);
    const y = (value) => (100 * (high - value)) / (high - low);
    const rows = ticks(low, high, 4);
    at(id).replaceChildren(
      ...rows.map((value) => svg("line", { x2: "100%", y1: `${y(value)}%`, y2: `${y(value)}%` })),
      ...rows.map((value) => svg("text", { x: -6, y: `${y(value)}%`, dy: 4 }, minus(value))),
      ...ticks(scene.begin, scene.end, 9).map((t) =>
        svg("text", { class: "second", x: percent(t), y: "100%", dy: 16 }, `${minus(t)} s`),
      ),
      svg(
        "svg",
        { viewBox: "0 0 100 100", preserveAspectRatio: "none" },
        ...lines.map(([kind, points]) =>
          svg("polyline", { class: kind, points: points.map(([t, value]) => `${part(t)},${y(value)}`).join(" ") }),
        ),
      ),
    );
  };
  const draw = () => {
    const runs = [[trial, ""], ...(scene.ghost ? [[scene.ghost, "ghost"]] : [])];
    const both = (points) =>
      runs.flatMap(([{ sides }, kind]) => Object.entries(sides).map(([side, of]) => [`${side} ${kind}`, points(of)]));
    chart(
      "chart-v",
      both(({ t, v }) => t.map((time, i) => [time, v[i]])),
    );
    // A sample's acceleration covers the step before it.
    const steps = ({ t, a }) => t.slice(1).flatMap((time, i) => [t[i], time].map((edge) => [edge, a[i + 1]]));
    chart("chart-a", both(steps), trial.track.hardest, -trial.track.hardest);
    const headways = runs
      .filter(([{ sides }]) => SIDES.every((side) => sides[side]))
      .map(([{ sides }, kind]) => [kind, sides.left.t.map((t, i) => [t, sides.left.x[i] - sides.right.x[i]])]);
    // Where no headway is a collision, the band has no width.
    const bounds = trial.bounds.map((bound, i) => [Object.values(trial.sides)[0].t[i], bound ?? 0]);
    const band = [...bounds, ...bounds.map(([t, bound]) => [t, -bound]).reverse()];
    chart("chart-h", [["bound", band], ...headways]);
    for (const { link, t, usual, until } of ribbons.all()) {
      Object.assign(link.parentElement.style, {
        left: percent(t),
        width: `calc(${part(until) - part(t)}% - 2px)`,
        // The last one may be short: it has its letter still, but no more room than the others.
        minWidth: `min(14px, ${part(usual) - part(t)}% - 1px)`,
      });
    }
    at("timeline").classList.add("placed");
    mark();
  };

  // The moments: who merges, a collision, whatever else the page was told of.
  const mark = () => {
    const others = (scene.ghost?.marks ?? []).map((one) => ({ ...one, other: true }));
    // What drivers choose stands in the ribbons.
    const all = [...trial.marks, ...others]
      .filter(({ kind }) => kind !== "choice")
      .sort((a, b) => a.t - b.t)
      .map((one) => {
        const symbol = ({ merge: "▾", collision: "✸" }[one.kind] ?? "◆") + (one.side[0] ?? "").toUpperCase();
        return {
          ...one,
          symbol: one.other ? `(${symbol})` : symbol,
          kind: `moment ${one.kind.replaceAll(" ", "-")} ${one.side}${one.other ? " other" : ""}`,
          words: `${one.t.toFixed(1)} s: ${one.other ? "the other trial: " : ""}${one.text}`,
        };
      });
    at("lines").replaceChildren(
      ...all.map(({ t, kind, symbol, words }, i) => {
        // In three rows, so that moments close to each other do not cover each other.
        const line = element("span", { class: kind, title: words }, element("b", { class: `row${i % 3}` }, symbol));
        line.style.left = percent(t);
        return line;
      }),
    );
    at("moments").replaceChildren(
      ...all.map(({ t, kind, symbol, words }) => {
        const button = element("button", { type: "button", class: kind }, `${symbol} ${words}`);
        button.addEventListener("click", () => seek(t));
        return element("li", {}, button);
      }),
    );
  };
  at("charts").addEventListener("click", ({ clientX, currentTarget }) => {
    const { left, width } = currentTarget.getBoundingClientRect();
    seek(scene.begin + ((scene.end - scene.begin) * (clientX - left)) / width);
  });
  return {
    draw,
    show: () => {
      at("playhead").style.left = percent(scene.now);
    },
  };
};
