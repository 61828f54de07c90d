// The attitudes on the sphere of upward directions: two half spheres, true to area, z up and z down. What lies within a
// quarter of a right angle of an attitude counts as covered.

import { s } from "./dom.js";

const NEAR = Math.PI / 8;
const POINTS = 36;

// Place of a direction in its half sphere (Lambert azimuthal, its rim at 1).
function spot([x, y, z]) {
  const flat = Math.hypot(x, y), r = Math.SQRT2 * Math.sin(Math.atan2(flat, Math.abs(z)) / 2);
  return flat < 1e-9 ? [0, 0] : [r * x / flat, -r * y / flat];
}

const CENTRES = [-1.18, 1.18];
const half = up => (up[2] >= 0 ? 0 : 1);
const at = up => {
  const [x, y] = spot(up);
  return [(CENTRES[half(up)] + x).toFixed(3), y.toFixed(3)];
};

// The edge of what an attitude covers, in the half sphere with this sign of z; beyond the rim it goes on, and is cut off.
function cap(up, sign) {
  const [x, y, z] = up, aside = Math.abs(x) < 0.9 ? [0, -z, y] : [z, 0, -x];
  const length = Math.hypot(...aside), u = aside.map(each => each / length);
  const v = [y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]];
  const points = Array.from({ length: POINTS }, (_, k) => {
    const angle = 2 * Math.PI * k / POINTS;
    const edge = [0, 1, 2].map(i => Math.cos(NEAR) * up[i] + Math.sin(NEAR) * (Math.cos(angle) * u[i] + Math.sin(angle) * v[i]));
    const flat = Math.hypot(edge[0], edge[1]) || 1, r = Math.SQRT2 * Math.sin(Math.atan2(flat, sign * edge[2]) / 2);
    return `${(r * edge[0] / flat).toFixed(3)},${(-r * edge[1] / flat).toFixed(3)}`;
  });
  return points.join(" ");
}

export const spherePlace = () => s("svg", { class: "sphere", viewBox: "-2.42 -1.3 4.84 2.78", role: "img" });

export function drawSphere(place, view) {
  const covered = [1, -1].map((sign, side) => s("svg", {
    x: CENTRES[side] - 1, y: -1, width: 2, height: 2, viewBox: "-1 -1 2 2",
  }, s("clipPath", { id: `half${side}` }, s("circle", { r: 1 })),
    s("g", { class: "covered-part", "clip-path": `url(#half${side})` },
      view.attitudes.filter(({ up }) => sign * up[2] > -Math.sin(NEAR)).map(({ up }) => s("polygon", { points: cap(up, sign) })))));
  const marks = view.attitudes.map(held => {
    const [cx, cy] = at(held.up);
    return s("circle", { class: held.aside ? "held aside" : "held", cx, cy, r: held.aside ? 0.1 : 0.055 }, s("title", {}, `attitude ${held.number}`));
  });
  if (view.next) {
    const [cx, cy] = at(view.next);
    marks.push(s("circle", { class: "next", cx, cy, r: 0.16 }));
  }
  if (view.up) {
    const [x, y] = at(view.up).map(Number);
    marks.push(s("path", { class: "now-mark", d: `M${x - 0.12} ${y}H${x + 0.12}M${x} ${y - 0.12}V${y + 0.12}` }));
  }
  const discs = CENTRES.map(centre => [
    s("circle", { class: "disc", cx: centre, cy: 0, r: 1 }),
  ]);
  const over = CENTRES.flatMap((centre, side) => [
    s("path", { class: "grid", d: `M${centre - 1} 0h2M${centre} -1v2` }),
    s("circle", { class: "rim", cx: centre, cy: 0, r: 1 }),
    s("text", { class: "rim-text", x: centre, y: 1.33 }, ["z up", "z down"][side]),
    s("text", { class: "rim-text axis-x", x: centre + 1.12, y: 0.06 }, "x"),
    s("text", { class: "rim-text axis-y", x: centre, y: -1.08 }, "y"),
  ]);
  place.setAttribute("aria-label", `${view.attitudes.length} attitudes on the sphere of upward directions`);
  place.replaceChildren(...discs.flat(), ...covered, ...over, ...marks);
}
