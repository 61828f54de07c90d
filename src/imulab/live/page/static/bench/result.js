// The result of a fit as it is seen first: verdict, three numbers, the residuals, and what to do next.

import { h, inWords, loadPlotly } from "../dom.js";

const HEADS = { good: "Good", look: "Look first", bad: "Stop" };
const FACTS = 3;
const HIGHEST = 340; // pixels of the picture on a wide screen
const bare = ([, value]) => Number(/^[\d.]*$/.test(value)); // counts say less than what has a unit
// The colours of reports at night, as its own script turns them.
const NIGHT = {
  "#ffffff": "#1a2228", "#22303a": "#dce5ea", "#e6eaed": "#35414a", "#d5dbdf": "#4a5761", "#9aa5ad": "#8997a1", "#1f6f8b": "#5bb6d4", "#c8553d": "#f0896f", "#e6f1f4": "#21343d",
  "#f4efe6": "#39424a", "#12303c": "#e3f2f8", "#2e4057": "#a9bddb", "#2c4fa3": "#7f9df0", "#a8322f": "#e8706c", "#7a5c99": "#b79ad4", "#6f7f3f": "#a5b86a",
};
const dark = matchMedia("(prefers-color-scheme: dark)");
const slim = matchMedia("(max-width: 640px)");

async function draw(place, figure, onPaper) {
  const Plotly = await loadPlotly();
  if (!place.isConnected) return;
  const colour = name => (dark.matches && !onPaper && NIGHT[name]) || name;
  const shown = slim.matches && !onPaper && figure.narrow ? figure.narrow : figure;
  const { data, layout } = JSON.parse(JSON.stringify({ data: figure.data, layout: shown.layout }).replace(/#[0-9a-f]{6}/g, colour));
  const base = {
    font: { family: 'system-ui, "Segoe UI", "DejaVu Sans", sans-serif', size: 13, color: colour("#22303a") }, margin: { l: 70, r: 20, t: 20, b: 55 }, hovermode: "closest",
    paper_bgcolor: colour("#ffffff"), plot_bgcolor: colour("#ffffff"), height: shown === figure ? Math.min(shown.height, HIGHEST) : shown.height, ...(onPaper ? { width: 640 } : {}),
  };
  Plotly.react(place, data, { ...layout, ...base }, { responsive: !onPaper, displayModeBar: false });
}

// What to do with a record next; `act` runs it.
function steps(found, act) {
  const button = (text, run, kind) => h("button", { type: "button", class: kind, onclick: () => run(found.record) }, text);
  const target = h("select", { "aria-label": "Write for another program" }, act.targets().map(each => h("option", {}, each)));
  return h("div", { class: "nextsteps", role: "group", "aria-label": "What to do next" },
    h("h3", {}, "Next"),
    h("div", { class: "actions" },
      act.can("apply") && found.procedure !== "noise" ? button("Correct a recording", name => act.form("apply", name), "main") : null,
      button("Firmware (zip)", name => act.export(name, "c", {})),
      act.can(`${found.procedure} check`) ? button("Check with a new recording", name => act.form(`${found.procedure} check`, name)) : null,
      h("span", { class: "pick" }, target, button("Write", name => act.export(name, target.value, {})))));
}

export function result(found, act) {
  const picture = found.figure ? h("div", { class: "picture", role: "img", "aria-label": `${found.figure.title}: ${found.figure.caption}` }) : null;
  if (picture) {
    const again = paper => draw(picture, found.figure, paper).catch(() => {});
    new IntersectionObserver((seen, observer) => { if (seen.some(each => each.isIntersecting)) { observer.disconnect(); again(false); } }).observe(picture);
    dark.addEventListener("change", () => again(false));
    slim.addEventListener("change", () => again(false));
    addEventListener("beforeprint", () => again(true));
    addEventListener("afterprint", () => again(false));
  }
  return h("div", { class: "found" },
    h("div", { class: `said ${found.state}` }, h("strong", { class: "state" }, `${HEADS[found.state]}. `), found.headline,
      found.reasons.length ? h("ul", {}, found.reasons.map(each => h("li", {}, inWords(each)))) : null,
      found.next.map(each => h("p", {}, h("b", {}, "next: "), inWords(each)))),
    h("dl", { class: "facts" }, [...found.facts].sort((one, other) => bare(one) - bare(other)).slice(0, FACTS).map(([label, value]) => h("div", {}, h("dt", {}, label), h("dd", {}, value)))),
    picture ? h("figure", {}, h("figcaption", {}, h("strong", {}, found.figure.title), h("span", { class: "caption" }, found.figure.caption)), picture) : null,
    steps(found, act));
}

// A refusal of an export that would lose something: the choice to write it all the same.
export const lossy = (job, act) => h("div", { class: "said look" },
  h("p", {}, inWords(job.messages.find(each => /lossy/.test(each)).replace(/^imulab: /, "").replace(/; add --lossy.*$/, "."))),
  h("button", { type: "button", onclick: () => act.again(job) }, "Write it without that"));
