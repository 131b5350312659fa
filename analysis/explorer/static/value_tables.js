"use strict";
// What charts draw as tables: thousands of numbers, of which each table is written when it is opened.
(() => {
  const signed = (value) => `${value < 0 ? "" : "+"}${value.toFixed(2)}`;
  const samples = () => {
    const { sides } = JSON.parse(document.getElementById("replay-data").textContent);
    const driven = Object.entries(sides);
    const headings = ["t (s)", ...driven.flatMap(([side]) => [`${side} x (m)`, "v (m/s)", "a (m/s²)"]), "headway (m)"];
    return [headings, driven[0][1].t.map((t, i) => {
      const values = driven.flatMap(([, { x, v, a }]) => [x[i].toFixed(2), v[i].toFixed(2), signed(a[i])]);
      const [left, right] = driven.map(([, { x }]) => x[i]);
      return [t.toFixed(2), ...values, right === undefined ? "" : signed(left - right)];
    })];
  };
  const plan = (details) => {
    const { plan, before, applied, steps, step_s, most_mps2 } = JSON.parse(details.dataset.chart);
    const digits = Number.isInteger(Math.round(step_s * 1e6) / 1e5) ? 1 : 2;
    return [["after (s)", "plan (m/s²)", "before", "driven"], Array.from({ length: steps }, (_, i) => [
      (i * step_s).toFixed(digits),
      ...[plan, before, applied].map((values) => (i < values.length ? signed(values[i] * most_mps2) : "")),
    ])];
  };
  document.addEventListener("toggle", ({ target }) => {
    const made = target.id === "samples" ? samples : target.matches(".plan-table") ? plan : null;
    if (!made || !target.open || target.querySelector("table")) return;
    const [headings, rows] = made(target);
    // Numbers, and words of ours: nothing in them is markup.
    const head = headings.map((heading) => `<th scope="col">${heading}</th>`).join("");
    const body = rows.map((row) => `<tr>${row.map((value) => `<td class="number">${value}</td>`).join("")}</tr>`).join("");
    target.insertAdjacentHTML("beforeend", `<div class="scroll" tabindex="0"><table class="dense"><thead><tr>${head}</tr></thead><tbody>${body}</tbody></table></div>`);
  }, true);
})();
