// Draws one figure of a notebook. The library comes packed with the first figure of a page and serves all others.
(async (id, plot, packed) => {
  const unpack = async () => {
    const bytes = Uint8Array.from(atob(packed), letter => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const own = { exports: {} }, others = window.Plotly;
    new Function("module", "exports", await new Response(stream).text())(own, own.exports);
    window.Plotly = others;
    return own.exports;
  };
  if (packed) window.imulabPlotly ??= unpack();
  for (let tries = 0; tries < 100; tries++) {
    const place = document.getElementById(id);
    if (place && window.imulabPlotly) {
      (await window.imulabPlotly).newPlot(place, plot.data, plot.layout, { responsive: true, displaylogo: false });
      return;
    }
    await new Promise(later => setTimeout(later, 100));
  }
  const place = document.getElementById(id);
  if (place) place.textContent = "Not drawn: run the first cell with a figure again, or restart the kernel and run all.";
})