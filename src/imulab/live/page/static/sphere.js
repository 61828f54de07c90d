// The attitudes on the sphere of upward directions: two half spheres, true to area, z up and z down.

import { s } from "./dom.js";

const CAP = 0.2;

// Place of a direction in its half sphere (Lambert azimuthal, its rim at 1).
function spot([x, y, z]) {
  const flat = Math.hypot(x, y), r = Math.SQRT2 * Math.sin(Math.atan2(flat, Math.abs(z)) / 2);
  return flat < 1e-9 ? [0, 0] : [r * x / flat, -r * y / flat];
}

const at = (centre, up) => {
  const [x, y] = spot(up);
  return [(centre + x).toFixed(3), y.toFixed(3)];
};

export const spherePlace = () => s("svg", { class: "sphere", viewBox: "-2.42 -1.28 4.84 2.72", role: "img" });

export function drawSphere(place, view) {
  const half = up => (up[2] >= 0 ? -1.18 : 1.18);
  const marks = [];
  for (const held of view.attitudes) {
    const [x, y] = at(half(held.up), held.up);
    marks.push(s("g", { class: held.aside ? "held aside" : "held" },
      s("circle", { cx: x, cy: y, r: CAP }), s("text", { x, y: (+y + 0.07).toFixed(3) }, held.number)));
  }
  if (view.next) {
    const [cx, cy] = at(half(view.next), view.next);
    marks.push(s("circle", { class: "next", cx, cy, r: CAP }));
  }
  if (view.up) {
    const [x, y] = at(half(view.up), view.up).map(Number);
    marks.push(s("path", { class: "now-mark", d: `M${x - 0.11} ${y}H${x + 0.11}M${x} ${y - 0.11}V${y + 0.11}` }));
  }
  const discs = [[-1.18, "z up"], [1.18, "z down"]].flatMap(([centre, title]) => [
    s("circle", { class: "rim", cx: centre, cy: 0, r: 1 }),
    s("path", { class: "grid", d: `M${centre - 1} 0h2M${centre} -1v2` }),
    s("text", { class: "rim-text", x: centre, y: 1.3 }, title),
    s("text", { class: "rim-text", x: centre + 1.11, y: 0.06 }, "x"),
    s("text", { class: "rim-text", x: centre, y: -1.06 }, "y"),
  ]);
  place.setAttribute("aria-label", `${view.attitudes.length} attitudes on the sphere of directions`);
  place.replaceChildren(...discs, ...marks);
}
