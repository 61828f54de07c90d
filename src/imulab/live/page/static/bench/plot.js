// The curves of a recording: a plot for each sensor, all over the same range; zooming asks the server for more.
//
// Drawn as SVG of its own: colours follow the style sheet (also in the dark), and a new range is drawn in a few
// milliseconds, where Plotly takes some hundred for as many points.

import { h, put, s, show } from "../dom.js";
import { ask } from "./net.js";

const HEIGHT = 170;
const LEFT = 62;
const RIGHT = 10;
const TOP = 18;
const BOTTOM = 24;
const FEWEST = 5;

function ticks(low, high, most) {
  const span = high - low;
  if (!(span > 0)) return { at: [low], digits: 3 };
  const raw = span / most;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(each => each * power).find(each => each >= raw);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const at = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) at.push(k * step);
  return { at, digits: Math.min(digits, 12) };
}

// Columns by sensor: accel_x, accel_y and accel_z share a plot where they share a unit.
export function sensors(units) {
  const found = new Map();
  for (const [name, unit] of Object.entries(units)) {
    const parts = name.split("_");
    const stem = ["truth", "std"].includes(parts[0]) ? parts.slice(0, 2).join("_") : parts[0];
    const key = `${stem} [${unit}]`;
    if (!found.has(key)) found.set(key, []);
    found.get(key).push(name);
  }
  return found;
}

// `place` is where the plots go. `plot.open(message)` shows a recording as the server has told of it.
export function plots(place) {
  let known = null;
  let range = [null, null];
  let shown = null;
  let asked = null;
  let waiting = false;
  let drag = null;
  let drawn = [];
  let offset = 0;

  const status = h("p", { class: "range", role: "status" });
  const tool = (label, text, act) => h("button", { type: "button", class: "tool", "aria-label": label, title: label, onclick: act }, text);
  const tools = h("div", { class: "tools", role: "group", "aria-label": "Range of the plots" },
    tool("earlier", "←", () => pan(-0.5)), tool("later", "→", () => pan(0.5)), tool("closer", "+", () => zoom(0.5)),
    tool("wider", "−", () => zoom(2)), tool("the whole recording", "whole", () => go(null, null)));
  const area = h("div", { class: "plots" });
  place.append(h("div", { class: "plotbar" }, status, tools), area);

  const ends = () => [range[0] ?? known.head.first, range[1] ?? known.head.last];

  function go(low, high) {
    if (!known?.head) return;
    const { first, last, rows } = known.head;
    const least = FEWEST * (last - first) / Math.max(rows, 1);
    if (low !== null && high - low < least) [low, high] = [(low + high - least) / 2, (low + high + least) / 2];
    if (low !== null && high - low >= last - first) [low, high] = [null, null];
    else if (low !== null && low < first) [low, high] = [first, first + high - low];
    else if (low !== null && high > last) [low, high] = [last - (high - low), last];
    range = [low, high];
    fetch();
  }
  function pan(part) { const [low, high] = ends(); go(low + part * (high - low), high + part * (high - low)); }
  function zoom(factor, middle) {
    const [low, high] = ends();
    const at = middle ?? (low + high) / 2;
    go(at - (at - low) * factor, at + (high - at) * factor);
  }

  async function fetch() {
    asked?.abort();
    const own = asked = new AbortController();
    const query = new URLSearchParams({ opening: known.opening, width: Math.round(area.clientWidth || 800) });
    if (range[0] !== null) { query.set("from", range[0]); query.set("to", range[1]); }
    const began = performance.now();
    try {
      const found = await ask(`curves?${query}`, undefined, { signal: own.signal });
      if (own !== asked || !known) return;
      shown = found;
      draw();
      area.dataset.took = Math.round(performance.now() - began);
    } catch (error) {
      if (error.name !== "AbortError" && known) put(status, error.message);
    }
  }

  function draw() {
    const head = known.head;
    const groups = sensors(head.units);
    const [low, high] = ends();
    offset = Math.abs(head.first) > 1e6 ? Math.floor(head.first) : 0;
    const width = Math.max(area.clientWidth, 200);
    drawn = [...groups].map(([title, names], number) => one(title, names, low, high, width, number === groups.size - 1));
    area.replaceChildren(...drawn);
    const unit = head.timed ? "s" : "";
    const digits = ticks(low, high, 8).digits + 1;
    const from = head.timed ? "" : "rows ";
    put(status, `${from}${(low - offset).toFixed(digits)} to ${(high - offset).toFixed(digits)} ${unit}${offset ? ` after ${offset} s` : ""}`.trim());
  }

  function one(title, names, low, high, width, last) {
    const inner = width - LEFT - RIGHT;
    const x = value => LEFT + (value - low) / (high - low || 1) * inner;
    let [least, most] = [Infinity, -Infinity];
    for (const name of names) {
      for (const value of shown.low[name]) if (value !== null && value < least) least = value;
      for (const value of shown.high[name]) if (value !== null && value > most) most = value;
    }
    if (least > most) [least, most] = [0, 1];
    if (least === most) [least, most] = [least - (Math.abs(least) * 1e-3 || 1), most + (Math.abs(most) * 1e-3 || 1)];
    const pad = 0.04 * (most - least);
    const y = value => TOP + (most + pad - value) / (most - least + 2 * pad) * (HEIGHT - TOP - BOTTOM);
    const clip = `clip-${title.replace(/\W/g, "-")}`;
    const across = ticks(low - offset, high - offset, Math.max(2, inner / 65));
    const up = ticks(least, most, 4);
    const svg = s("svg", {
      class: "plot", viewBox: `0 0 ${width} ${HEIGHT}`, width, height: HEIGHT, role: "img", tabindex: 0,
      "aria-label": `${title}: ${names.join(", ")}, from ${least.toPrecision(4)} to ${most.toPrecision(4)}. Arrow keys move, plus and minus zoom, 0 shows the whole.`,
    },
      s("clipPath", { id: clip }, s("rect", { x: LEFT, y: TOP, width: inner, height: HEIGHT - TOP - BOTTOM })),
      up.at.map(value => [
        s("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }),
        s("text", { x: LEFT - 6, y: y(value) + 4, class: "tick end" }, value.toFixed(up.digits)),
      ]),
      across.at.map(value => [
        s("line", { class: "grid", x1: x(value + offset), x2: x(value + offset), y1: TOP, y2: HEIGHT - BOTTOM }),
        s("text", { x: x(value + offset), y: HEIGHT - BOTTOM + 15, class: "tick middle" }, value.toFixed(across.digits)),
      ]),
      s("g", { "clip-path": `url(#${clip})` },
        marks(x, low, high),
        names.map((name, number) => s("path", { class: `curve c${number % 8}`, d: path(name, x, y) }))),
      s("text", { x: LEFT, y: 12, class: "name" }, title),
      last ? s("text", { x: width - RIGHT, y: HEIGHT - BOTTOM + 15, class: "tick end unit" }, known.head.timed ? "" : "row") : null,
      s("g", { class: "key" }, key(names, width)),
      s("rect", { class: "selection", y: TOP, height: HEIGHT - TOP - BOTTOM, visibility: "hidden" }));
    listen(svg, low, high, inner);
    return svg;
  }

  function key(names, width) {
    const few = names.slice(0, 9);
    const long = Math.max(...few.map(name => name.length)) * 6.6 + 22;
    const step = Math.min(long, (width - LEFT - RIGHT - 170) / few.length);
    if (step < 22) return [];
    return few.map((name, number) => {
      const at = width - RIGHT - (few.length - number) * step;
      const own = step < long ? name.slice(name.lastIndexOf("_") + 1) : name;
      return [s("rect", { class: `chip c${number % 8}`, x: at, y: 4, width: 10, height: 8 }), s("text", { x: at + 14, y: 12, class: "tick" }, own)];
    });
  }

  function marks(x, low, high) {
    const inside = each => each[1] >= low && each[0] <= high;
    const found = (known.attitudes || []).map((each, number) => ({ each, number })).filter(({ each }) => inside(each));
    const gaps = known.head.gaps.filter(inside);
    return [
      found.map(({ each, number }) => [
        s("rect", { class: "attitude", x: x(each[0]), y: TOP, width: Math.max(1, x(each[1]) - x(each[0])), height: HEIGHT - TOP - BOTTOM },
          s("title", {}, `attitude ${number + 1}: ${each[0].toFixed(1)} to ${each[1].toFixed(1)} s`)),
        x(each[1]) - x(each[0]) > 14 ? s("text", { class: "number", x: Math.max(x(each[0]), LEFT) + 2, y: TOP + 10 }, String(number + 1)) : null,
      ]),
      gaps.map(each => s("rect", { class: "gap", x: x(each[0]), y: TOP, width: Math.max(1.5, x(each[1]) - x(each[0])), height: HEIGHT - TOP - BOTTOM },
        s("title", {}, `gap of ${(each[1] - each[0]).toPrecision(3)} s`))),
    ];
  }

  // Along the largest samples and back along the smallest; a new piece behind each gap.
  function path(name, x, y) {
    const { at, until } = shown;
    const [low, high] = [shown.low[name], shown.high[name]];
    const breaks = new Set(shown.breaks);
    const pieces = [];
    let piece = [];
    at.forEach((_, k) => {
      if ((breaks.has(k) || low[k] === null) && piece.length) { pieces.push(piece); piece = []; }
      if (low[k] !== null) piece.push(k);
    });
    if (piece.length) pieces.push(piece);
    const point = (k, value) => `${x((at[k] + until[k]) / 2).toFixed(1)} ${y(value).toFixed(1)}`;
    return pieces.map(each => {
      const there = each.map(k => point(k, high[k]));
      const back = each.map(k => point(k, low[k])).reverse();
      return `M${there.join("L")}L${back.join("L")}Z`;
    }).join("");
  }

  function listen(svg, low, high, inner) {
    const value = event => {
      const box = svg.getBoundingClientRect();
      const part = ((event.clientX - box.left) * (inner + LEFT + RIGHT) / box.width - LEFT) / inner;
      return low + Math.min(1, Math.max(0, part)) * (high - low);
    };
    const selection = svg.querySelector(".selection");
    svg.addEventListener("pointerdown", event => {
      if (event.button !== 0) return;
      drag = value(event);
      svg.setPointerCapture(event.pointerId);
    });
    svg.addEventListener("pointermove", event => {
      if (drag === null) return;
      const [a, b] = [drag, value(event)].sort((one, other) => one - other);
      const x = at => LEFT + (at - low) / (high - low) * inner;
      selection.setAttribute("x", x(a));
      selection.setAttribute("width", Math.max(0, x(b) - x(a)));
      selection.setAttribute("visibility", "visible");
    });
    svg.addEventListener("pointerup", event => {
      if (drag === null) return;
      const [a, b] = [drag, value(event)].sort((one, other) => one - other);
      drag = null;
      selection.setAttribute("visibility", "hidden");
      if (b - a > 0.01 * (high - low)) go(a, b);
    });
    svg.addEventListener("pointercancel", () => { drag = null; selection.setAttribute("visibility", "hidden"); });
    svg.addEventListener("dblclick", () => go(null, null));
    svg.addEventListener("wheel", event => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoom(event.deltaY > 0 ? 1.5 : 1 / 1.5, value(event));
    }, { passive: false });
    svg.addEventListener("keydown", event => {
      const act = { ArrowLeft: () => pan(-0.25), ArrowRight: () => pan(0.25), "+": () => zoom(0.5), "=": () => zoom(0.5), "-": () => zoom(2), 0: () => go(null, null), Home: () => go(null, null) }[event.key];
      if (!act) return;
      event.preventDefault();
      const number = drawn.indexOf(svg);
      act();
      const again = new MutationObserver(() => { again.disconnect(); drawn[number]?.focus(); });
      again.observe(area, { childList: true });
    });
  }

  new ResizeObserver(() => {
    if (known?.head && shown && Math.abs(Number(drawn[0]?.getAttribute("width")) - area.clientWidth) > 2) draw();
  }).observe(area);

  return {
    open(message) {
      const other = known?.opening !== message.opening;
      const more = other || known.head?.rows !== message.head?.rows;
      known = message;
      if (other) { range = [null, null]; shown = null; area.replaceChildren(); put(status, ""); }
      const some = Boolean(known.head?.rows);
      show(tools, some);
      if (!some) return;
      if (!more) {
        if (shown) draw();
      } else if (!waiting) {  // while it is read, not more often than it can be drawn
        waiting = true;
        fetch().finally(() => setTimeout(() => {
          waiting = false;
          if (known?.head && shown && known.head.rows !== message.head.rows) fetch();
        }, 250));
      }
    },
    close() { asked?.abort(); known = null; shown = null; area.replaceChildren(); put(status, ""); show(tools, false); },
    go,
  };
}
