// A unit as a body with labelled axes, by the one thing that gravity tells: which of its directions points up.

import { s } from "./dom.js";

const HALF = [0.62, 0.45, 0.17];
const AXIS = 1.12, LABEL = 1.36;
const TURN = -35 * Math.PI / 180, ABOVE = 24 * Math.PI / 180;
const OPPOSITE = -0.99;

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => a.map(each => each / Math.hypot(...a));
const times = (R, a) => R.map(row => dot(row, a));
const transposed = R => [0, 1, 2].map(k => R.map(row => row[k]));
export const product = (A, B) => A.map(row => transposed(B).map(column => dot(row, column)));

export function degreesBetween(a, b) {
  return Math.acos(Math.min(1, Math.max(-1, dot(a, b)))) * 180 / Math.PI;
}

// The rotation about an axis by an angle.
function turn(axis, angle) {
  const [x, y, z] = unit(axis), c = Math.cos(angle), d = 1 - c, e = Math.sin(angle);
  return [
    [c + x * x * d, x * y * d - z * e, x * z * d + y * e],
    [y * x * d + z * e, c + y * y * d, y * z * d - x * e],
    [z * x * d - y * e, z * y * d + x * e, c + z * z * d],
  ];
}

// An orientation that is dragged on the screen, by angles to the right and downward.
export function dragged(R, right, down) {
  const across = [Math.cos(TURN), -Math.sin(TURN), 0];
  const up = [Math.sin(TURN) * Math.sin(ABOVE), Math.cos(TURN) * Math.sin(ABOVE), Math.cos(ABOVE)];
  return product(turn(across, down), product(turn(up, right), R));
}

// The shortest rotation that takes direction a to b; of opposite ones about the axis of the body that is most across.
export function shortest(a, b) {
  let axis = cross(a, b), angle = Math.acos(Math.min(1, Math.max(-1, dot(a, b))));
  if (dot(a, b) < OPPOSITE) {
    const sizes = a.map(Math.abs), across = [0, 0, 0];
    across[sizes.indexOf(Math.min(...sizes))] = 1;
    axis = cross(a, cross(across, a));
  }
  if (angle < 1e-9) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  return turn(axis, angle);
}

// An orientation with this direction up.
export const upright = up => shortest(up, [0, 0, 1]);

function seen([x, y, z]) {
  const across = Math.cos(TURN) * x - Math.sin(TURN) * y, away = Math.sin(TURN) * x + Math.cos(TURN) * y;
  return { x: across, y: -(z * Math.cos(ABOVE) + away * Math.sin(ABOVE)), near: z * Math.sin(ABOVE) - away * Math.cos(ABOVE) };
}

const fixed = value => value.toFixed(3);

function face(R, axis, sign) {
  const normal = [0, 0, 0];
  normal[axis] = sign;
  const turned = times(R, normal);
  if (seen(turned).near <= 0) return null;
  const [one, other] = [0, 1, 2].filter(k => k !== axis);
  const corners = [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([p, q]) => {
    const corner = [0, 0, 0];
    corner[axis] = sign * HALF[axis];
    corner[one] = p * HALF[one];
    corner[other] = q * HALF[other];
    const at = seen(times(R, corner));
    return `${fixed(at.x)},${fixed(at.y)}`;
  });
  return s("polygon", { points: corners.join(" "), class: "face", "fill-opacity": fixed(0.34 + 0.22 * turned[2]) });
}

function arrow(R, axis) {
  const from = [0, 0, 0], to = [0, 0, 0], label = [0, 0, 0];
  from[axis] = HALF[axis];
  to[axis] = AXIS;
  label[axis] = LABEL;
  const [a, b, c] = [from, to, label].map(each => seen(times(R, each)));
  const along = Math.hypot(b.x - a.x, b.y - a.y) || 1, ux = (b.x - a.x) / along, uy = (b.y - a.y) / along;
  const tip = [[0, 0], [-0.17, 0.075], [-0.17, -0.075]]
    .map(([p, q]) => `${fixed(b.x + p * ux - q * uy)},${fixed(b.y + p * uy + q * ux)}`).join(" ");
  const kind = `axis axis-${"xyz"[axis]}`;
  const group = s("g", { class: kind },
    s("line", { x1: fixed(a.x), y1: fixed(a.y), x2: fixed(b.x - 0.1 * ux), y2: fixed(b.y - 0.1 * uy) }),
    along > 0.2 ? s("polygon", { points: tip }) : s("circle", { cx: fixed(b.x), cy: fixed(b.y), r: 0.07 }),
    s("text", { x: fixed(c.x), y: fixed(c.y + 0.09) }, "xyz"[axis]));
  return { group, near: b.near };
}

// Draws an orientation into an SVG element.
export function drawBody(place, R) {
  const arrows = [0, 1, 2].map(axis => arrow(R, axis));
  const faces = [0, 1, 2].flatMap(axis => [face(R, axis, 1), face(R, axis, -1)]).filter(Boolean);
  const low = Math.abs(R[2][0]) * HALF[0] + Math.abs(R[2][1]) * HALF[1] + Math.abs(R[2][2]) * HALF[2];
  place.replaceChildren(
    s("ellipse", { class: "ground", cx: 0, cy: fixed(low * Math.cos(ABOVE) + 0.06), rx: 1.05, ry: fixed(1.05 * Math.sin(ABOVE)) }),
    ...arrows.filter(each => each.near < 0).map(each => each.group),
    ...faces,
    ...arrows.filter(each => each.near >= 0).map(each => each.group));
}

export const bodyPlace = label => s("svg", { class: "body", viewBox: "-1.55 -1.5 3.1 3", role: "img", "aria-label": label });
