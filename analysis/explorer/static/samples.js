"use strict";
// Every sample of a trial as a table: a thousand numbers, written when somebody opens it.
document.addEventListener("toggle", ({ target }) => {
  if (target.id !== "samples" || !target.open || target.querySelector("table")) return;
  const sides = Object.entries(JSON.parse(document.getElementById("replay-data").textContent).sides);
  const signed = (value) => `${value < 0 ? "" : "+"}${value.toFixed(2)}`;
  const headings = ["t (s)", ...sides.flatMap(([side]) => [`${side} x (m)`, "v (m/s)", "a (m/s²)"]), "headway (m)"];
  const rows = sides[0][1].t.map((t, i) => {
    const values = sides.flatMap(([, { x, v, a }]) => [x[i].toFixed(2), v[i].toFixed(2), signed(a[i])]);
    const [own, other] = sides.map(([, { x }]) => x[i]);
    return [t.toFixed(2), ...values, other === undefined ? "" : signed(own - other)];
  });
  // Numbers and words of ours: nothing in them is markup.
  const head = headings.map((heading) => `<th scope="col">${heading}</th>`).join("");
  const body = rows.map((row) => `<tr>${row.map((value) => `<td class="number">${value}</td>`).join("")}</tr>`).join("");
  target.insertAdjacentHTML("beforeend", `<div class="scroll" tabindex="0"><table class="dense"><thead><tr>${head}</tr></thead><tbody>${body}</tbody></table></div>`);
}, true);
