// The curves of a recording: a plot for each sensor, all over the same range; zooming asks the server for more. A drag
// along a plot takes a range of time, one up or down a range of values; what is under the pointer is read out over all.
//
// Drawn as SVG of its own: colours follow the style sheet (also in the dark), and a new range is drawn in a few
// milliseconds, where Plotly takes some hundred for as many points.

import { h, put, s, show } from "../dom.js";
import { measure } from "./measure.js";
import { ask } from "./net.js";
import { recall, keep } from "./state.js";
import { pretty, written } from "./units.js";

const HEIGHT = 170;
const LEFT = 62;
const RIGHT = 10;
const TOP = 6;
const BOTTOM = 24;
const LABELLED = 18; // of the lowest plot, whose axis has a name
const FEWEST = 5;
const STEEP = 1.5; // of a drag that takes values, not time
const LEAST = 8; // pixels of a drag

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
    const key = `${stem}${pretty(unit) ? ` [${pretty(unit)}]` : ""}`;
    if (!found.has(key)) found.set(key, []);
    found.get(key).push(name);
  }
  return found;
}

// `place` is where the plots go. `plot.open(message)` shows a recording as the server has told of it. `act.ranged(range)`
// hears of every range, `act.use(range)` of one that a command is to take.
export function plots(place, act) {
  let known = null;
  let range = [null, null];
  let shown = null;
  let rows = 0; // of the recording when `shown` was asked for
  let asked = null;
  let waiting = false;
  let drag = null;
  let drawn = [];
  let offset = 0;
  let pointed = null; // the time that is read out
  let spans = {}; // by plot, the values that it shows where it does not show all

  const status = h("p", { class: "range", role: "status" });
  const tool = (label, text, act) => h("button", { type: "button", class: "tool", "aria-label": label, title: label, onclick: act }, text);
  const tools = h("div", { class: "tools", role: "group", "aria-label": "Range of the plots" },
    tool("earlier", "←", () => pan(-0.5)), tool("later", "→", () => pan(0.5)), tool("closer", "+", () => zoom(0.5)),
    tool("wider", "−", () => zoom(2)), tool("the whole recording", "whole", () => { spans = {}; go(null, null); }));
  const window_ = h("button", { type: "button", class: "usewindow", onclick: () => act.use(ends()) }, "Use this window");
  tools.append(window_);
  const area = h("div", { class: "plots" });
  const numbers = measure(() => ({ opening: known?.opening, range, units: known?.head?.units || {}, timed: known?.head?.timed }));
  place.append(h("div", { class: "plotbar" }, status, tools), area, numbers.element);

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
    act.ranged(range);
    fetch();
    numbers.refresh();
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
    const { rows: ready } = known.head;
    area.setAttribute("aria-busy", "true");
    const query = new URLSearchParams({ opening: known.opening, width: Math.round(area.clientWidth || 800) });
    if (range[0] !== null) { query.set("from", range[0]); query.set("to", range[1]); }
    const began = performance.now();
    try {
      const found = await ask(`curves?${query}`, undefined, { signal: own.signal });
      if (own !== asked || !known) return;
      [shown, rows] = [found, ready];
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
    const controls = () => [...area.querySelectorAll("svg.plot, .channel")];
    const focused = controls().indexOf(document.activeElement);
    const boxes = [...groups].map(([title, names], number) => one(title, names, low, high, width, number === groups.size - 1));
    drawn = boxes.map(each => each.svg);
    area.replaceChildren(...boxes.map(each => each.element));
    controls()[focused]?.focus();
    if (pointed !== null) point(pointed >= low && pointed <= high ? pointed : null);
    area.setAttribute("aria-busy", String(!known.done || rows !== head.rows));
    show(window_, range[0] !== null && head.timed);
    const unit = head.timed ? "s" : "";
    const digits = ticks(low, high, 8).digits + 1;
    const from = head.timed ? "" : "rows ";
    put(status, `${from}${(low - offset).toFixed(digits)} to ${(high - offset).toFixed(digits)} ${unit}${offset ? ` after ${since()}` : ""}`.trim());
  }

  const since = () => (offset > 1.2e9 ? `${new Date(offset * 1000).toISOString().slice(0, 19).replace("T", " ")} UTC` : `${offset} s`);
  const isHidden = name => Boolean(recall("hidden", name));

  // A plot with its legend, whose buttons hide channels and read out what is under the pointer.
  function one(title, names, low, high, width, last) {
    const values = names.map(() => h("span", { class: "value" }));
    const legend = h("div", { class: "legend" }, h("strong", {}, title), names.map((name, number) => h("button", {
      type: "button", class: "channel", "aria-pressed": String(!isHidden(name)), title: isHidden(name) ? `show ${name}` : `hide ${name}`,
      onclick: () => { keep("hidden", name, !isHidden(name)); draw(); },
    }, h("span", { class: `swatch c${number % 8}`, "aria-hidden": "true" }), name, values[number])));
    const svg = picture(title, names.map((name, number) => ({ name, number })).filter(({ name }) => !isHidden(name)), low, high, width, last);
    svg.readout = k => names.forEach((name, number) => {
      const [least, most] = k === null ? [null, null] : [shown.low[name][k], shown.high[name][k]];
      put(values[number], k === null || least === null ? "" : least === most ? written(least) : `${written((least + most) / 2)}`);
    });
    return { svg, element: h("div", { class: "plotbox" }, legend, svg) };
  }

  function picture(title, channels, low, high, width, last) {
    const names = channels.map(each => each.name);
    const bottom = BOTTOM + (last ? LABELLED : 0);
    const height = HEIGHT - BOTTOM + bottom;
    const inner = width - LEFT - RIGHT;
    const x = value => LEFT + (value - low) / (high - low || 1) * inner;
    let [least, most] = [Infinity, -Infinity];
    for (const name of names) {
      for (const value of shown.low[name]) if (value !== null && value < least) least = value;
      for (const value of shown.high[name]) if (value !== null && value > most) most = value;
    }
    if (least > most) [least, most] = [0, 1];
    if (spans[title]) [least, most] = spans[title];
    if (least === most) [least, most] = [least - (Math.abs(least) * 1e-3 || 1), most + (Math.abs(most) * 1e-3 || 1)];
    const pad = spans[title] ? 0 : 0.04 * (most - least);
    const y = value => TOP + (most + pad - value) / (most - least + 2 * pad) * (HEIGHT - TOP - BOTTOM);
    const valueAt = pixel => most + pad - (pixel - TOP) / (HEIGHT - TOP - BOTTOM) * (most - least + 2 * pad);
    const clip = `clip-${title.replace(/\W/g, "-")}`;
    const across = ticks(low - offset, high - offset, Math.max(2, inner / 65));
    const up = ticks(least, most, 4);
    const svg = s("svg", {
      class: "plot", viewBox: `0 0 ${width} ${height}`, width, height, role: "img", tabindex: 0,
      "aria-label": `${title}: ${names.join(", ")}, from ${least.toPrecision(4)} to ${most.toPrecision(4)}. Arrow keys left and right move, up and down zoom its values, plus and minus zoom the time, 0 shows the whole.`,
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
        channels.map(({ name, number }) => s("path", { class: `curve c${number % 8}`, d: path(name, x, y) }))),
      last ? s("text", { x: LEFT + inner / 2, y: HEIGHT - BOTTOM + 34, class: "tick middle axis" }, known.head.timed ? `time, s${offset ? ` after ${since()}` : ""}` : "row") : null,
      s("line", { class: "cursor", y1: TOP, y2: HEIGHT - BOTTOM, visibility: "hidden" }),
      s("rect", { class: "selection", visibility: "hidden" }));
    svg.at = x;
    listen(svg, { low, high, inner, title, valueAt, span: [least - pad, most + pad] });
    return svg;
  }

  // Reads all plots out at a place, and marks it; at none, takes that away.
  function point(place) {
    pointed = place;
    let k = null;
    if (place !== null && shown.at.length) {
      k = shown.at.findIndex(each => each > place) - 1;
      if (k < -1) k = shown.at.length - 1;
      k = Math.max(k, 0);
    }
    for (const svg of drawn) {
      svg.readout(k);
      const line = svg.querySelector(".cursor");
      line.setAttribute("visibility", k === null ? "hidden" : "visible");
      if (k !== null) { line.setAttribute("x1", svg.at(place)); line.setAttribute("x2", svg.at(place)); }
    }
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

  function listen(svg, { low, high, inner, title, valueAt, span }) {
    const scaled = event => {
      const box = svg.getBoundingClientRect();
      return { x: (event.clientX - box.left) * (inner + LEFT + RIGHT) / box.width, y: Math.min(HEIGHT - BOTTOM, Math.max(TOP, (event.clientY - box.top) * (inner + LEFT + RIGHT) / box.width)) };
    };
    const placeOf = x => low + Math.min(1, Math.max(0, (x - LEFT) / inner)) * (high - low);
    const selection = svg.querySelector(".selection");
    const mark = (x, y, width, height) => Object.entries({ x, y, width: Math.max(0, width), height: Math.max(0, height), visibility: "visible" }).forEach(([key, value]) => selection.setAttribute(key, value));
    const between = event => {
      const now = scaled(event);
      const steep = Math.abs(now.y - drag.y) > STEEP * Math.abs(now.x - drag.x);
      const [a, b] = [drag, now].map(each => (steep ? each.y : each.x)).sort((one, other) => one - other);
      return { steep, a, b };
    };
    const end = () => { drag = null; selection.setAttribute("visibility", "hidden"); };
    svg.addEventListener("pointerdown", event => {
      if (event.button !== 0) return;
      drag = scaled(event);
      svg.setPointerCapture(event.pointerId);
    });
    svg.addEventListener("pointermove", event => {
      point(placeOf(scaled(event).x));
      if (drag === null) return;
      const { steep, a, b } = between(event);
      if (steep) mark(LEFT, a, inner, b - a);
      else mark(Math.max(a, LEFT), TOP, Math.min(b, LEFT + inner) - Math.max(a, LEFT), HEIGHT - TOP - BOTTOM);
    });
    svg.addEventListener("pointerup", event => {
      if (drag === null) return;
      const { steep, a, b } = between(event);
      end();
      if (b - a < LEAST) return;
      if (steep) { spans[title] = [valueAt(b), valueAt(a)]; draw(); } else go(placeOf(a), placeOf(b));
    });
    svg.addEventListener("pointerleave", () => { if (drag === null) point(null); });
    svg.addEventListener("pointercancel", end);
    const tall = factor => {
      const [least, most] = span;
      const [middle, half] = [(least + most) / 2, (most - least) / 2 * factor];
      spans[title] = [middle - half, middle + half];
      draw();
    };
    svg.addEventListener("dblclick", () => { spans = {}; go(null, null); });
    svg.addEventListener("wheel", event => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoom(event.deltaY > 0 ? 1.5 : 1 / 1.5, placeOf(scaled(event).x));
    }, { passive: false });
    svg.addEventListener("keydown", event => {
      const whole = () => { spans = {}; go(null, null); };
      const keys = { ArrowLeft: () => pan(-0.25), ArrowRight: () => pan(0.25), ArrowUp: () => tall(0.5), ArrowDown: () => tall(2), "+": () => zoom(0.5), "=": () => zoom(0.5), "-": () => zoom(2), 0: whole, Home: whole };
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
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
      if (other) { range = act.begin(); spans = {}; shown = pointed = null; area.replaceChildren(); put(status, ""); }
      const some = Boolean(known.head?.rows);
      show(tools, some);
      show(numbers.element, Boolean(some && message.done));
      if (!some) return;
      if (message.done && other) numbers.refresh();
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
    close() { asked?.abort(); known = null; shown = null; area.replaceChildren(); put(status, ""); show(tools, false); show(numbers.element, false); },
    go,
    // Another range, because the address says so.
    follow(wanted) { if (known?.head && wanted.join() !== range.join()) { range = wanted; fetch(); numbers.refresh(); } },
  };
}
