// Draws `plots`: again where the window becomes a phone's, night falls, or the page goes to paper. Marks tables that scroll.
const source = JSON.stringify(plots);
const night = {
  "#ffffff": "#1a2228", "#22303a": "#dce5ea", "#e6eaed": "#35414a", "#d5dbdf": "#4a5761", "#9aa5ad": "#8997a1",
  "#1f6f8b": "#5bb6d4", "#c8553d": "#f0896f", "#e6f1f4": "#21343d", "#f4efe6": "#39424a", "#12303c": "#e3f2f8",
  "#2e4057": "#a9bddb", "#2c4fa3": "#7f9df0", "#a8322f": "#e8706c", "#7a5c99": "#b79ad4", "#6f7f3f": "#a5b86a"
};
const dark = matchMedia("(prefers-color-scheme: dark)");
const slim = matchMedia("(max-width: 640px)");
function draw(onPaper) {
  const dim = dark.matches && !onPaper;
  const colour = name => (dim && night[name]) || name;
  const text = dim ? source.replace(/#[0-9a-f]{6}/g, colour) : source;
  const base = {
    font: { family: 'system-ui, "Segoe UI", "DejaVu Sans", sans-serif', size: 13, color: colour("#22303a") },
    margin: { l: 70, r: 20, t: 20, b: 55 }, hovermode: "closest",
    paper_bgcolor: colour("#ffffff"), plot_bgcolor: colour("#ffffff")
  };
  JSON.parse(text).forEach((plot, number) => {
    if (!plot) return;
    const shown = slim.matches && !onPaper && plot.narrow ? plot.narrow : plot;
    const size = onPaper ? { width: 640, height: Math.min(0.75 * shown.height, 620) } : { height: shown.height };
    const place = document.getElementById("plot-" + number);
    place.style.height = size.height + "px";
    Plotly.newPlot(place, plot.data, { ...base, ...shown.layout, ...size }, {
      responsive: !onPaper, displaylogo: false, displayModeBar: onPaper || slim.matches ? false : "hover",
      modeBarButtonsToRemove: ["select2d", "lasso2d", "sendChartToCloud"]
    });
  });
}
draw(false);
dark.addEventListener("change", () => draw(false));
slim.addEventListener("change", () => draw(false));
addEventListener("beforeprint", () => draw(true));
addEventListener("afterprint", () => draw(false));
const mark = new ResizeObserver(boxes => boxes.forEach(({ target }) =>
  target.parentElement.classList.toggle("wider", target.scrollWidth > target.clientWidth + 1)));
document.querySelectorAll(".scroll").forEach(box => mark.observe(box));
document.documentElement.dataset.drawn = plots.filter(Boolean).length;
