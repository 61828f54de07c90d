// What is known, and from which attitudes.

import { h } from "./dom.js";

const MILLI_G = 1e3 / 9.80665;

// A residual, m/s², in mg.
export const milli = residual => (residual * MILLI_G).toFixed(2).replace(/^-(0\.0*)$/, "$1").replace("-", "−");

const table = (label, titles, rows) =>
  h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": label }, h("table", {},
    h("thead", {}, h("tr", {}, titles.map(([text, kind]) => (text ? h("th", { scope: "col", class: kind }, text) : h("td", {}))))),
    h("tbody", {}, rows)));

// How far a standard uncertainty is from its target, in words and as a bar that is full where it is met.
function against(share) {
  const text = share === null || share === undefined ? "not yet" : share <= 1 ? "met" : `${share.toPrecision(2)} × too large`;
  return [h("meter", { min: 0, max: 1, value: share ? Math.min(1, 1 / share) : 0, "aria-hidden": "true" }), ` ${text}`];
}

export function targetList(now) {
  return h("ul", { class: "targets" }, now.targets.map(([text, share]) =>
    h("li", { class: share !== null && share <= 1 ? "met" : null }, h("strong", {}, text), " ", against(share))));
}

export function parameterTable(now) {
  if (!now.parameters.length) {
    return h("p", { class: "caption" }, "No result yet: more attitudes are needed.");
  }
  const held = now.parameters.some(each => each.share !== null && each.share !== undefined);
  const titles = [["parameter"], ["value"], ["±"], ["unit", "unit"], ...(held ? [["± against target", "text"]] : [])];
  return table("Parameters", titles, now.parameters.map(each => h("tr", {},
    h("td", {}, each.name), h("td", {}, each.value), h("td", {}, each.uncertainty), h("td", { class: "unit" }, each.unit),
    held && h("td", { class: "text share" }, each.share === null || each.share === undefined ? "" : against(each.share)))));
}

export function attitudeTable(now, drop) {
  if (!now.attitudes.length) return h("p", { class: "caption" }, "None yet.");
  const titles = [["no."], ["up", "text words"], ["|f| − g, mg"], ["held, s", "held-for"], ...(drop ? [["", "text"]] : [])];
  return table("Attitudes", titles, now.attitudes.map(each => h("tr", { class: each.aside ? "aside" : null },
    h("td", {}, each.aside ? `${each.number} (off)` : each.number),
    h("td", { class: "text words" }, each.words),
    h("td", {}, each.residual === null ? "–" : milli(each.residual)),
    h("td", { class: "held-for" }, each.seconds.toFixed(1)),
    drop && h("td", { class: "text" },
      h("button", { class: "small", "aria-label": `Drop attitude ${each.number}`, onclick: () => drop(each.number) }, "drop")))).reverse());
}
