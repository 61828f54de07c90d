// The last ten seconds of the accelerometers: lowest and highest reading of each tenth of a second, and rest between.

import { h, s } from "./dom.js";

const WIDE = 600, HIGH = 150, SECONDS = 10, LEAST = 1.6;

const unitOf = view => view.unit.replace("^2", "²");
const fixed = value => value.toFixed(1);

// A round step of an axis for a range of values.
function step(range) {
  const power = 10 ** Math.floor(Math.log10(range));
  return [1, 2, 5, 10].map(each => each * power).find(each => range / each <= 3);
}

const number = (value, size) => value.toFixed(Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(size))))).replace("-", "−");

export class Strip {
  constructor() {
    this.drawing = s("svg", { class: "strip", viewBox: `0 0 ${WIDE} ${HIGH}`, preserveAspectRatio: "none", "aria-hidden": "true" });
    this.high = h("span", {});
    this.low = h("span", {});
    this.values = [0, 1, 2].map(axis => h("span", { class: `axis-${"xyz"[axis]}` }));
    this.unit = h("span", { class: "unit" });
    this.place = h("section", { class: "readings" },
      h("h2", {}, "Last 10 s"),
      h("p", { class: "values", "aria-label": "Readings now" }, this.values, this.unit),
      h("div", { class: "plotted" }, this.drawing, h("p", { class: "scale" }, this.high, this.low)),
      h("p", { class: "times" }, h("span", {}, "−10 s"), h("span", {}, "now")));
  }

  draw(view) {
    const rows = view.strip;
    this.place.hidden = !rows.length;
    if (!rows.length) return;
    const all = rows.flatMap(row => row.slice(1));
    const size = Math.max(...all.map(Math.abs)) || 1;
    const low = Math.min(...all, 0), high = Math.max(...all, 0), room = 0.06 * (high - low) || size;
    const y = value => HIGH * (high + room - value) / (high - low + 2 * room);
    const x = time => WIDE * (1 + time / SECONDS);
    const grid = step(high - low || size);
    const lines = [];
    for (let value = Math.ceil(low / grid) * grid; value <= high; value += grid) {
      lines.push(s("path", { class: Math.abs(value) < grid / 2 ? "zero" : "grid", d: `M0 ${fixed(y(value))}H${WIDE}` }));
    }
    const bands = [0, 1, 2].map(axis => {
      const edges = rows.map(row => [fixed(x(row[0])), y(row[4 + axis]), y(row[1 + axis])]).map(([at, top, bottom]) => {
        const lack = Math.max(0, LEAST - (bottom - top)) / 2;
        return [at, fixed(top - lack), fixed(bottom + lack)];
      });
      const there = edges.map(([at, top]) => `${at},${top}`), back = edges.reverse().map(([at, , bottom]) => `${at},${bottom}`);
      return s("polygon", { class: `band axis-${"xyz"[axis]}`, points: [...there, ...back].join(" ") });
    });
    this.drawing.replaceChildren(...lines, ...bands);
    const last = rows[rows.length - 1];
    this.values.forEach((place, axis) => {
      place.textContent = `${"xyz"[axis]} ${number((last[1 + axis] + last[4 + axis]) / 2, size)}`;
    });
    this.unit.textContent = unitOf(view);
    this.high.textContent = number(high, size);
    this.low.textContent = number(low, size);
  }
}
