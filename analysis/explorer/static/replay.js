"use strict";
// The replay of a trial: track, charts, ribbons and clock, all of one moment.
// Where a decision's panel and another trial's data come from; a page without a server has its own.
window.explorer ??= (() => {
  const answer = async (address) => {
    const reply = await fetch(address);
    if (!reply.ok) throw new Error(`${reply.status}`);
    return reply;
  };
  return {
    panel: async (link) => (await answer(link.dataset.panel)).text(),
    data: async (option) => (await answer(option.dataset.url)).json(),
  };
})();
window.startReplay = () => {
  const holder = document.getElementById("replay-data");
  if (!holder) return;
  const at = (id) => document.getElementById(id);
  const trial = JSON.parse(holder.textContent);
  // Read anew at each drawing: the system may turn from light to dark, and paper is light.
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
  const HEIGHT = 130, PAPER = 660; // of a chart, and the width of one in print, in pixels
  const SPEEDS = [0.25, 0.5, 1, 2, 4];
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const road = trial.track;
  const own = (trial.sides.left ?? trial.sides.right).t;
  const begin = own[0];
  // With a second trial the time goes on to the end of the later one.
  let times = own;
  let now = begin, playing = false, speed = 1, last = 0, ghost = null, selected = null;

  const end = () => Math.max(trial.end, ghost?.end ?? 0);
  const lost = () => { at("lost").hidden = false; };

  // ---- one moment of a trial

  const sampled = (xs, ys, t) => {
    if (t <= xs[0]) return ys[0];
    let i = xs.findIndex((x) => x >= t);
    if (i < 0) return ys[ys.length - 1];
    const part = (t - xs[i - 1]) / (xs[i] - xs[i - 1]);
    return ys[i - 1] + part * (ys[i] - ys[i - 1]);
  };
  const inside = (run, t) => t <= run.end + 1e-9;

  // ---- the track, from left to right; the left branch is above

  const SVG = "http://www.w3.org/2000/svg";
  const draw = (name, attributes, parent, text) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text) made.textContent = text;
    parent.append(made);
    return made;
  };
  const sign = (side) => (side === "left" ? -1 : 1);
  const place = (side, s) => s >= road.merge
    ? [road.merge * road.forward + s - road.merge, 0]
    : [s * road.forward, sign(side) * (road.merge - s) * road.lateral];
  const turned = (side, s) => s >= road.merge ? 0
    : -sign(side) * Math.atan2(road.lateral, road.forward) * 180 / Math.PI;

  const track = at("track");
  const vehicles = {};
  // A vehicle as large as its trial has it; about this trial's, what its collision rule looks at.
  const judged = {
    euclid2d: ({ length }) => ["circle", { r: length / 2 }],
    rectangle: ({ length, width }) => ["rect", { x: -length / 2, y: -width / 2, width: length, height: width }],
    shared_lane: ({ length }) => ["rect", { x: -length / 2, y: -0.35, width: length, height: 0.7 }],
  };
  const build = (name, run) => {
    const { length, width, rule } = run.track;
    for (const side of ["left", "right"]) {
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
  const [mergeX] = place("left", road.merge);
  const drawTrack = () => {
    const [endX] = place("left", road.end);
    for (const kind of ["kerb", "lane"]) {
      for (const side of ["left", "right"]) {
        const [x, y] = place(side, 0);
        draw("polyline", { class: kind, points: `${x},${y} ${mergeX},0 ${endX},0` }, track);
      }
    }
    for (const side of ["left", "right"]) {
      const [x0, y0] = place(side, 0), [x1, y1] = place(side, road.tunnel);
      draw("line", { class: "tunnel", x1: x0, y1: y0, x2: x1, y2: y1 }, track);
      draw("text", { class: "sign", x: x1, y: y1 + (side === "left" ? -5.8 : 7.6) }, track, "tunnel exit");
      draw("text", { class: "sign side", x: 0, y: 0.9, transform: `translate(${place(side, 4).join(" ")}) rotate(${turned(side, 4)})` }, track, `${side} tunnel`);
    }
    draw("line", { class: "merge", x1: mergeX, y1: -4, x2: mergeX, y2: 4 }, track);
    draw("text", { class: "sign", x: mergeX, y: -5.2 }, track, "merge point");
    draw("text", { class: "sign", x: endX - 5, y: -3.4 }, track, "end");
    for (const name of ["ghost", "own"]) {
      vehicles[name] = {};
      for (const side of ["left", "right"]) vehicles[name][side] = draw("g", { class: `vehicle ${name} ${side}` }, track);
    }
    build("own", trial);
    vehicles.crash = draw("g", { class: "crash" }, track);
    vehicles.between = draw("line", {}, vehicles.crash);
    vehicles.crashed = draw("text", { y: 13.5 }, vehicles.crash);
  };
  const move = (name, run) => {
    for (const side of ["left", "right"]) {
      const group = vehicles[name][side];
      const samples = run?.sides[side];
      group.toggleAttribute("hidden", !samples);
      group.setAttribute("display", samples ? "inline" : "none");
      if (!samples) continue;
      const s = sampled(samples.t, samples.x, now);
      const [x, y] = place(side, s);
      group.setAttribute("transform", `translate(${x.toFixed(2)} ${y.toFixed(2)}) rotate(${turned(side, s).toFixed(1)})`);
      group.classList.toggle("over", !inside(run, now));
    }
  };

  // ---- charts on one time axis

  const charts = [];
  const clickable = (u) => {
    u.over.addEventListener("click", (event) => {
      seek(u.posToVal(event.clientX - u.over.getBoundingClientRect().left, "x"), true);
    });
    u.over.addEventListener("mouseleave", show);
  };
  const resampled = (run, side, what) => times.map((t) => {
    const samples = run.sides[side];
    return samples && t <= run.end + 1e-9 && t >= samples.t[0] - 1e-9 ? sampled(samples.t, samples[what], t) : null;
  });
  const headways = (run) => {
    const left = resampled(run, "left", "x"), right = resampled(run, "right", "x");
    return left.map((x, i) => (x === null || right[i] === null ? null : x - right[i]));
  };
  const series = (label, colour, extra) => ({
    label, stroke: colour, width: 1.6, points: { show: false },
    value: (_, v) => (v === null || v === undefined ? "–" : v.toFixed(2)), ...extra,
  });
  const chart = (id, heading, unit, own, others, { scales, ...extra } = {}) => {
    const axis = { stroke: colour("ink"), grid: { stroke: colour("line") }, ticks: { stroke: colour("line") } };
    const plot = new uPlot({
      title: heading, width: at("charts").clientWidth, height: HEIGHT, legend: { live: true },
      cursor: { sync: { key: "replay" }, drag: { x: false, y: false } },
      scales: { x: { time: false }, ...scales },
      axes: [{ ...axis, size: 24, gap: 2, values: (_, ticks) => ticks.map((t) => `${t} s`) }, { ...axis, size: 54, label: unit, labelSize: 18, labelGap: 0 }],
      series: [{ label: "t", value: (_, v) => (v === null || v === undefined ? "–" : `${v.toFixed(1)} s`) }, ...own.map(([s]) => s), ...others.map(([s]) => s)],
      hooks: { ready: [clickable, () => { placeRibbons(); show(); }] }, ...extra,
    }, [times, ...own.map(([, values]) => values), ...others.map(([, values]) => values)], at(id));
    plot.playhead = document.createElement("div");
    plot.playhead.className = "playhead";
    plot.over.append(plot.playhead);
    charts.push(plot);
  };
  const drawCharts = () => {
    for (const plot of charts.splice(0)) plot.destroy();
    times = [...own, ...(ghost ? (ghost.sides.left ?? ghost.sides.right).t : []).filter((t) => t > trial.end + 1e-9)];
    at("scrub").max = end();
    const dashed = { dash: [4, 4], width: 1.2 };
    const lines = (run, what, note, extra) => ["left", "right"].map((side) =>
      [series(`${side}${note}`, colour(side), extra), resampled(run, side, what)]);
    const both = (id, heading, unit, what, extra, options) => chart(id, heading, unit,
      lines(trial, what, "", extra), ghost ? lines(ghost, what, ", other", { ...dashed, ...extra }) : [], options);
    both("chart-v", "Velocity", "m/s", "v", {});
    const banded = { width: 0.5, value: (_, v) => (v ? v.toFixed(2) : "–") };
    // A sample's acceleration is that of the step before it.
    both("chart-a", "Acceleration", "m/s²", "a", { paths: uPlot.paths.stepped({ align: -1 }) },
      { scales: { y: { range: (_, low, high) => [Math.min(low, -road.hardest), Math.max(high, road.hardest)] } } });
    // Where none is, the band has no width.
    const bound = times.map((t, i) => (inside(trial, t) && trial.bounds.length ? trial.bounds[i] ?? 0 : null));
    const lower = bound.map((b) => (b === null ? null : -b));
    chart("chart-h", "Headway: how far the left vehicle is ahead; shaded: collision", "m",
      [[series("headway", colour("ink")), headways(trial)],
        [series("collision below", colour("edge"), banded), bound], [series("and above", colour("edge"), banded), lower]],
      ghost ? [[series("headway, other", colour("ink"), dashed), headways(ghost)]] : [],
      { bands: [{ series: [2, 3], fill: colour("collision") }] });
  };

  // ---- ribbons of decisions, on the same axis

  const decisions = [...document.querySelectorAll("a.decision")];
  const begins = (link) => Number(link.dataset.t);
  const until = (link) => Math.min(begins(link) + trial.every[link.dataset.side], trial.end);
  const placeRibbons = () => {
    const ribbons = at("ribbons");
    if (!ribbons || !charts.length) return;
    const box = charts[0].over.getBoundingClientRect(), base = ribbons.getBoundingClientRect();
    const offset = box.left - base.left, scale = (t) => charts[0].valToPos(t, "x");
    for (const link of decisions) {
      link.parentElement.style.left = `${offset + scale(begins(link))}px`;
      link.parentElement.style.width = `${Math.max(14, scale(until(link)) - scale(begins(link)) - 2)}px`;
    }
    ribbons.classList.add("placed");
  };
  const ordered = [...decisions].sort((a, b) => a.dataset.t - b.dataset.t || a.dataset.side.localeCompare(b.dataset.side));
  const select = (link, { push = true, jump = true } = {}) => {
    for (const other of decisions) other.removeAttribute("aria-current");
    selected = link;
    if (!link) return;
    link.setAttribute("aria-current", "true");
    if (jump) seek(Number(link.dataset.t));
    const panel = document.querySelector("#decision .decision-panel");
    if (panel?.dataset.side !== link.dataset.side || panel?.dataset.n !== link.dataset.n) {
      explorer.panel(link).then((html) => {
        at("lost").hidden = true;
        if (selected === link) at("decision").innerHTML = html;
      }, () => {
        lost();
        if (selected === link) at("decision").replaceChildren();
      });
    }
    remember(push);
  };
  const drives = (link) => begins(link) <= now + 1e-9 && now < until(link) - 1e-9;
  // From the one that is shown, or where the clock has left it, from the clock.
  const step = (by) => {
    let next = ordered.indexOf(selected) + by;
    if (!selected || !drives(selected)) {
      next = by > 0 ? ordered.findIndex((link) => begins(link) >= now - 1e-9)
        : ordered.findLastIndex((link) => begins(link) <= now + 1e-9);
      if (next < 0) next = by > 0 ? ordered.length - 1 : 0;
    }
    if (ordered.length) select(ordered[Math.min(Math.max(next, 0), ordered.length - 1)]);
  };

  // ---- the clock

  const show = () => {
    move("own", trial);
    move("ghost", ghost);
    const over = trial.status === "collided" && now >= trial.end - 1e-9;
    vehicles.crash.setAttribute("display", over ? "inline" : "none");
    track.classList.toggle("collided", over);
    const places = Object.values(trial.sides).map((samples) => sampled(samples.t, samples.x, now));
    track.classList.toggle("unjudged", road.rule === "shared_lane" && Math.max(...places) < road.merge);
    if (over) {
      const [left, right] = ["left", "right"].map((side) => trial.sides[side].x.at(-1));
      const [[x1, y1], [x2, y2]] = [place("left", left), place("right", right)];
      for (const [name, value] of Object.entries({ x1, y1, x2, y2 })) vehicles.between.setAttribute(name, value);
      // Beside the signs, and within the picture.
      vehicles.crashed.setAttribute("x", Math.min(Math.max((x1 + x2) / 2, mergeX - 3), mergeX + 15));
      vehicles.crashed.textContent = `✸ collision, ${{
        euclid2d: `${Math.hypot(x1 - x2, y1 - y2).toFixed(1)} m between the centres`,
        rectangle: "the outlines overlap",
        shared_lane: `${Math.abs(left - right).toFixed(1)} m apart along the road`,
      }[road.rule]}`;
    }
    at("scrub").value = now;
    at("scrub").setAttribute("aria-valuetext", `${now.toFixed(1)} s`);
    at("clock").textContent = `${now.toFixed(1)} s of ${end().toFixed(1)} s`;
    const told = ["left", "right"].filter((side) => trial.sides[side]).map((side) =>
      `${side} ${sampled(trial.sides[side].t, trial.sides[side].v, now).toFixed(1)} m/s at ${sampled(trial.sides[side].t, trial.sides[side].x, now).toFixed(1)} m`);
    at("now").textContent = told.join("; ");
    for (const link of decisions) link.classList.toggle("now", drives(link));
    const nearest = times.reduce((best, t, i) => (Math.abs(t - now) < Math.abs(times[best] - now) ? i : best), 0);
    for (const plot of charts) {
      plot.playhead.style.transform = `translateX(${plot.valToPos(now, "x")}px)`;
      if (plot.cursor.idx === null || plot.cursor.left < 0) plot.setLegend({ idx: nearest });
    }
  };
  const seek = (t, keep = false) => {
    now = Math.min(Math.max(t, begin), end());
    show();
    if (keep) remember(false);
  };
  const play = (on) => {
    if (on && now >= end() - 1e-9) now = begin;
    playing = on;
    at("play").textContent = on ? "Pause" : "Play";
    at("play").setAttribute("aria-pressed", String(on));
    last = performance.now();
    if (on) requestAnimationFrame(tick);
    else remember(false);
  };
  const tick = (moment) => {
    if (!playing) return;
    const passed = speed * (moment - last) / 1000;
    // Where the system asks for reduced motion, still pictures, two a second.
    if (!calm || passed >= 0.5 * speed) {
      last = moment;
      seek(now + passed);
    }
    if (now >= end() - 1e-9) play(false);
    else requestAnimationFrame(tick);
  };
  const setSpeed = (value) => {
    speed = value;
    at("speed").value = String(value);
  };

  // ---- the address tells the state

  const remember = (push) => {
    if (push === null) return; // what the address says is being done
    const address = new URL(location.href);
    const state = { t: now > begin ? now.toFixed(1) : "", side: selected?.dataset.side, decision: selected?.dataset.n, compare: ghost?.named };
    for (const [name, value] of Object.entries(state)) {
      if (value) address.searchParams.set(name, value);
      else address.searchParams.delete(name);
    }
    if (address.href === location.href) return;
    history[push ? "pushState" : "replaceState"](null, "", address);
  };
  const recall = async () => {
    const asked = new URL(location.href).searchParams;
    const link = decisions.find((d) => d.dataset.side === asked.get("side") && d.dataset.n === asked.get("decision"));
    select(link ?? null, { push: null, jump: !asked.has("t") });
    // Of one that is not there the page says so already.
    if (!asked.has("decision")) at("decision").innerHTML = at("unread").innerHTML;
    if ((asked.get("compare") ?? "") !== (ghost?.named ?? "")) await compare(asked.get("compare") ?? "", null);
    if (asked.has("t")) seek(Number(asked.get("t")) || begin);
    else if (!link) seek(begin);
  };

  // ---- a second trial

  const compare = async (id, push) => {
    const chooser = at("compare");
    // A name alone stands for the first of its specs, NAME@SPEC for one.
    const options = [...chooser.options].filter((o) => o.dataset.url);
    const option = id && (options.find((o) => o.value === id) ?? options.find((o) => o.value.startsWith(`${id}@`) || id.startsWith(`${o.value}@`)));
    ghost = option ? await explorer.data(option).catch(lost) ?? null : null;
    if (ghost) {
      ghost.named = option.value;
      at("lost").hidden = true;
      build("ghost", ghost);
    }
    chooser.value = ghost?.named ?? "";
    at("ghost-key").hidden = !ghost && (!id || option);
    at("ghost-key").textContent = ghost ? `dashed: ${ghost.label}. ${ghost.outcome}` : `${id} is not there to compare with`;
    drawCharts();
    seek(now);
    remember(push);
  };

  // ---- hands

  drawTrack();
  at("scrub").min = begin;
  at("scrub").addEventListener("input", (event) => seek(Number(event.target.value)));
  at("scrub").addEventListener("change", () => remember(false));
  at("play").addEventListener("click", () => play(!playing));
  at("back").addEventListener("click", () => seek(now - 0.1, true));
  at("on").addEventListener("click", () => seek(now + 0.1, true));
  // What is chosen is done with: the keys are the replay's again.
  at("speed").addEventListener("change", (event) => { setSpeed(Number(event.target.value)); event.target.blur(); });
  at("compare").addEventListener("change", (event) => { compare(event.target.value, true); event.target.blur(); });
  at("trial").addEventListener("click", (event) => {
    const asked = event.target.closest("a.decision, a.last");
    const link = asked && decisions.find((d) => d.dataset.side === asked.dataset.side && d.dataset.n === asked.dataset.n);
    if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    select(link);
  });
  // The list that led here, as it was filtered.
  const list = () => {
    const from = document.referrer && new URL(document.referrer);
    return from && from.origin === location.origin && from.pathname !== location.pathname && !from.pathname.startsWith("/trials/") ? from.href : at("trial").dataset.back;
  };
  addEventListener("popstate", recall);
  let width = 0;
  const fit = (wanted) => {
    if (wanted === width) return;
    width = wanted;
    for (const plot of charts) plot.setSize({ width, height: HEIGHT });
    placeRibbons();
    show();
  };
  new ResizeObserver(() => fit(at("charts").clientWidth)).observe(at("charts"));
  const paper = (on) => {
    document.documentElement.classList.toggle("paper", on);
    drawCharts();
    fit(on ? PAPER : at("charts").clientWidth);
  };
  addEventListener("beforeprint", () => paper(true));
  addEventListener("afterprint", () => paper(false));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawCharts);

  document.addEventListener("keydown", (event) => {
    if (isCommand(event) || document.querySelector("dialog[open]")) return;
    const target = event.target;
    if (target.matches("input:not([type=range]), select, textarea")) return;
    const by = event.shiftKey ? 1 : 0.1;
    if (event.key === " " && !target.matches("button, summary")) play(!playing);
    else if (event.key === "ArrowLeft") seek(now - by, true);
    else if (event.key === "ArrowRight") seek(now + by, true);
    else if (event.key === "]") step(1);
    else if (event.key === "[") step(-1);
    else if (event.key === "c") at("compare").focus();
    else if (/^[1-5]$/.test(event.key)) setSpeed(SPEEDS[Number(event.key) - 1]);
    else if (event.key === "Escape" && selected) { select(null); remember(true); at("decision").innerHTML = at("unread").innerHTML; }
    else if (event.key === "Escape" && list()) location.href = list();
    else return;
    event.preventDefault();
  });

  drawCharts();
  recall();
};
startReplay();
