// Shows the values under the pointer: the point of each curve that is nearest along the x axis.
for (const figure of document.querySelectorAll("figure.chart")) {
  const svg = figure.querySelector("svg");
  const cursor = figure.querySelector(".cursor");
  const output = figure.querySelector("output");
  const lines = JSON.parse(figure.querySelector("script").textContent);
  const nearest = (xs, x) =>
    xs.reduce((best, value, i) => (Math.abs(value - x) < Math.abs(xs[best] - x) ? i : best), 0);

  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * svg.viewBox.baseVal.width;
    const points = lines.map((line) => ({ line, i: nearest(line.x, x) }));
    const first = points[0];
    const at = first.line.x[first.i];
    cursor.setAttribute("x1", at);
    cursor.setAttribute("x2", at);
    cursor.style.visibility = "visible";
    const when = `${first.line.frames[first.i].toLocaleString("en")} frames, ${first.line.minutes[first.i]} min`;
    output.textContent = [when, ...points.map(({ line, i }) => `${line.label}: ${line.values[i]}`)].join("\n");
    output.style.display = "block";
  });
  svg.addEventListener("pointerleave", () => {
    cursor.style.visibility = "hidden";
    output.style.display = "none";
  });
}
