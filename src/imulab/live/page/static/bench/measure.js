// Mean, standard deviation and spectrum of what the plots show.

import { h, put, s, show } from "../dom.js";
import { ask } from "./net.js";
import { grouped, pretty, written } from "./units.js";

const WIDTH = 640, HEIGHT = 260, LEFT = 70, BOTTOM = 40, TOP = 8, RIGHT = 10;

// `what()` returns the opening, the range and the units.
export function measure(what) {
  const table = h("tbody", {});
  const said = h("p", { class: "message", role: "status" });
  const pick = h("select", { id: "spectrum-of", onchange: draw });
  const picture = h("div", { class: "spectrum" });
  const spectrum = h("div", {}, h("div", { class: "field" }, h("label", { for: "spectrum-of" }, "spectrum of"), pick), picture);
  const element = h("details", { class: "more measure", hidden: true, ontoggle: () => { if (element.open) refresh(); } },
    h("summary", {}, "Mean, standard deviation and spectrum of what is shown"), said,
    h("div", { class: "scroll", role: "region", "aria-label": "Mean and standard deviation", tabindex: 0 }, h("table", {},
      h("thead", {}, h("tr", {}, ["channel", "mean", "standard deviation", "unit"].map(each => h("th", { scope: "col", class: each === "unit" ? "unit" : null }, each)))), table)),
    spectrum);
  let found = null;
  let asked = 0;

  async function refresh() {
    const { opening, range, units } = what();
    if (!element.open || !opening) return;
    const own = asked += 1;
    const query = new URLSearchParams({ opening });
    if (range[0] !== null) { query.set("from", range[0]); query.set("to", range[1]); }
    put(said, "computing…");
    try {
      const answer = await ask(`statistics?${query}`);
      if (own !== asked) return;
      found = answer;
    } catch (error) {
      if (own === asked) put(said, error.message);
      return;
    }
    put(said, `${grouped(found.rows)} samples${range[0] === null ? ", the whole recording" : ""}.`);
    table.replaceChildren(...Object.keys(units).map(name => h("tr", {}, h("td", {}, name), h("td", {}, written(found.mean[name], 7)), h("td", {}, written(found.sigma[name], 4)), h("td", { class: "unit" }, pretty(units[name])))));
    const names = Object.keys(found.density);
    const groups = [...new Set(names.map(name => name.replace(/_[xyz]$/, "")))];
    const before = pick.value;
    pick.replaceChildren(...groups.map(each => h("option", { value: each, selected: each === before }, each)));
    show(spectrum, names.length > 0);
    draw();
  }

  // Amplitude density over frequency, both in powers of ten.
  function draw() {
    const names = Object.keys(found?.density || {}).filter(name => name.replace(/_[xyz]$/, "") === pick.value);
    if (!names.length) { picture.replaceChildren(); return; }
    const unit = pretty(what().units[names[0]]) || "1";
    const lines = names.map(name => found.density[name].map((each, k) => [found.frequencies[k], Math.sqrt(each)]).filter(([f, a]) => f > 0 && a > 0));
    const points = lines.flat();
    if (!points.length) { picture.replaceChildren(); return; }
    const ends = k => [Math.floor(Math.log10(Math.min(...points.map(each => each[k]))) * 2) / 2, Math.ceil(Math.log10(Math.max(...points.map(each => each[k]))) * 2) / 2];
    const [[x0, x1], [y0, y1]] = [ends(0), ends(1)];
    const x = f => LEFT + (Math.log10(f) - x0) / (x1 - x0 || 1) * (WIDTH - LEFT - RIGHT);
    const y = a => TOP + (y1 - Math.log10(a)) / (y1 - y0 || 1) * (HEIGHT - TOP - BOTTOM);
    const decades = (a, b) => Array.from({ length: Math.floor(b) - Math.ceil(a) + 1 }, (_, k) => 10 ** (Math.ceil(a) + k));
    const label = value => (value >= 0.001 && value < 10000 ? String(Number(value.toPrecision(1))) : value.toExponential(0).replace("e+", "e").replace("-", "−"));
    picture.replaceChildren(
      h("p", { class: "legend" }, names.map((name, number) => h("span", { class: "channel" }, h("span", { class: `swatch c${number % 8}`, "aria-hidden": "true" }), name))),
      s("svg", { class: "plot", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, width: WIDTH, height: HEIGHT, role: "img", "aria-label": `Spectrum of ${names.join(", ")}` },
        decades(x0, x1).map(f => [s("line", { class: "grid", x1: x(f), x2: x(f), y1: TOP, y2: HEIGHT - BOTTOM }), s("text", { class: "tick middle", x: x(f), y: HEIGHT - BOTTOM + 15 }, label(f))]),
        decades(y0, y1).map(a => [s("line", { class: "grid", x1: LEFT, x2: WIDTH - RIGHT, y1: y(a), y2: y(a) }), s("text", { class: "tick end", x: LEFT - 6, y: y(a) + 4 }, label(a))]),
        lines.map((line, number) => s("path", { class: `line c${number % 8}`, d: `M${line.map(([f, a]) => `${x(f).toFixed(1)} ${y(a).toFixed(1)}`).join("L")}` })),
        s("text", { class: "tick middle axis", x: LEFT + (WIDTH - LEFT - RIGHT) / 2, y: HEIGHT - 6 }, "frequency, Hz")),
      h("p", { class: "caption" }, `Amplitude density, ${unit}/√Hz (Welch, Hann windows).`));
  }

  return { element, refresh };
}
