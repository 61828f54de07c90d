// Elements without HTML: texts that files bring along stay texts.

const SVG = "http://www.w3.org/2000/svg";

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter(child => child !== null && child !== undefined && child !== false));
  return element;
}

// h("button", { class: "quiet", onclick: drop }, "drop")
export const h = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);
export const s = (tag, attributes, ...children) => fill(document.createElementNS(SVG, tag), attributes, children);

// Puts a text in place where it is another: a screen reader does not hear the same again, and a selection stays.
export function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function show(element, shown) {
  if (element.hidden === shown) element.hidden = !shown;
}

// Draws what is in an element anew where it has changed, and returns whether it has: what is the same keeps the focus.
export function redraw(element, children) {
  const drawn = [...element.children];
  if (children.length === drawn.length && children.every((each, number) => each.isEqualNode(drawn[number]))) return false;
  element.replaceChildren(...children);
  return true;
}

// Resolves once the mouse or the finger is up: what comes in the meantime would replace what it is on, and the click would
// be lost. A list that opens takes the release for itself.
let pressed = null;
let release = null;
const freed = () => setTimeout(() => { release?.(); pressed = release = null; }); // after the click
addEventListener("pointerdown", event => { if (event.button === 0 && !event.target.closest?.("select")) pressed ||= new Promise(done => { release = done; }); }, true);
for (const kind of ["pointerup", "pointercancel", "dragend"]) addEventListener(kind, freed, true);
addEventListener("blur", freed); // of the window alone: a press takes the focus from a field
addEventListener("pointermove", event => { if (pressed && !event.buttons) freed(); }, true);

export const unpressed = async () => pressed;

// A double click, or Enter held down, is one click: what it starts is started once. The range of plots moves with each.
const startsOnce = event => event.target.closest?.("button, a.button, input") && !event.target.closest(".tool");
addEventListener("click", event => {
  if (event.detail > 1 && startsOnce(event) && event.target.type !== "checkbox") { event.preventDefault(); event.stopImmediatePropagation(); }
}, true);
addEventListener("keydown", event => { if (event.repeat && event.key === "Enter" && startsOnce(event)) event.preventDefault(); }, true);

let plotly = null;
// Plotly, loaded when it is first asked for.
export function loadPlotly() {
  plotly ||= new Promise((done, failed) => {
    const script = h("script", { src: "/static/plotly.js", onload: () => done(window.Plotly), onerror: failed });
    document.head.append(script);
  });
  return plotly;
}

// A sentence as the page says it: options by the labels of their fields, without the command line's signs, but for
// commands in parentheses or quotes. To resume a session is for the terminal alone, and has no field.
export const inWords = text => text.split(/([('])(imulab [^)']+)/).map((part, number) => number % 3 ? part : part
  .replace(/--(?!resume\b)([a-z][a-z-]*)/g, (_, name) => `“${name.replaceAll("-", " ")}”`)
  .replace(/(^|\s)-o\b/g, "$1“output”").replace(/\bm\/s\^2\b/g, "m/s²")).join("");
