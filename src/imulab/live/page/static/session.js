// The guided session: what to do now above all, then where one is, then what is known.

import { bodyPlace, degreesBetween, dragged, drawBody, product, shortest, upright } from "./body.js";
import { h, inWords, put, show, unpressed } from "./dom.js";
import { ResultArea } from "./result.js";
import { Ring } from "./ring.js";
import { beep, soundButton, speak, voiceButton } from "./sound.js";
import { drawSphere, spherePlace } from "./sphere.js";
import { Strip } from "./strip.js";
import { attitudeTable, milli, parameterTable, targetList } from "./tables.js";

export const title = "Session";
const LOOK = 0.001, BAD = 0.05;
const NEAR = 12;
const PER_PIXEL = Math.PI / 180;
const LOG = 60;

let page = null, place = null, result = null;
let orientation = null, aim = null, drag = null;
let drawn = {};
const parts = {};

export function mount(into, given) {
  page = given;
  place = into;
  parts.advice = h("p", { class: "advice", role: "status", "aria-live": "assertive" }, "Connecting");
  parts.ring = new Ring();
  parts.state = h("span", { class: "state" });
  parts.loss = h("span", { class: "loss", role: "status" });
  parts.progress = h("progress", { max: 1, value: 0, "aria-label": "Attitudes" });
  parts.count = h("span", {});
  parts.finish = h("button", { "aria-describedby": "missing", onclick: () => page.send({ type: "finish" }) }, "Finish");
  parts.missing = h("span", { id: "missing", class: "missing" });
  parts.outlook = h("p", { class: "outlook" });
  parts.enough = h("p", { class: "enough", role: "status" });
  parts.now = h("div", { class: "now" },
    h("div", { class: "sign" }, parts.ring.place, parts.state),
    h("div", { class: "say" }, parts.advice, parts.outlook, parts.enough),
    parts.toward = h("div", { class: "toward" }, parts.progress, parts.count, parts.loss,
      h("span", { class: "actions" }, parts.missing, soundButton(), voiceButton(() => parts.advice.textContent), parts.finish)));
  parts.unknown = h("div", {});
  parts.knocked = h("div", { role: "alert" });
  parts.warnings = h("div", { role: "alert" });
  parts.next = bodyPlace("Next attitude");
  parts.nextText = h("figcaption", {});
  parts.live = bodyPlace("The unit now");
  parts.liveText = h("figcaption", {});
  parts.soon = h("span", {}, ", or ", h("button", { class: "small", onclick: () => aim?.up && page.send({ type: "turn", up: aim.up }) }, "Turn it so"));
  parts.hand = h("p", { class: "caption" }, "Simulated: drag it", parts.soon);
  parts.nextFigure = h("figure", { class: "wanted" }, h("h2", {}, "Turn it like this"), parts.next, parts.nextText);
  parts.bodies = h("section", { class: "bodies" },
    parts.nextFigure, h("figure", {}, h("h2", {}, "Now"), parts.live, parts.liveText, parts.hand));
  for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel"]) parts.live.addEventListener(kind, byHand);
  parts.place = placeForm();
  parts.sphere = spherePlace();
  parts.marks = h("span", {}, " Ring: next. Cross: now.");
  parts.strip = new Strip();
  parts.facts = h("dl", { class: "facts" });
  parts.parameters = h("div", {});
  parts.attitudes = h("div", {});
  parts.log = h("ol", { class: "log", tabindex: 0, "aria-label": "What happened" });
  result = new ResultArea(page);
  const beside = h("div", { class: "beside" }, parts.bodies,
    h("section", { class: "covered" }, h("h2", {}, "What is covered"), parts.sphere,
        h("p", { class: "caption" }, "Shaded: within 22° of an attitude held.", parts.marks)));
  const attitudes = h("section", {}, h("h2", {}, "Attitudes"), parts.attitudes);
  parts.known = h("section", {}, h("h2", {}, "Parameters"), parts.parameters);
  parts.later = [beside, attitudes];
  place.append(parts.now, parts.unknown, parts.knocked, parts.warnings, parts.place, result.place, beside, parts.strip.place, parts.facts, parts.known, attitudes,
    h("details", {}, h("summary", {}, "What happened"), parts.log));
}

export async function hear(message) {
  if (!drag) await unpressed(); // a body under the hand follows it
  if (message.type === "hello") parts.log.replaceChildren();  // what happened comes again
  if (message.type === "view") view(message);
  else if (message.type === "event") happened(message);
  else if (message.type === "done") {
    parts.now.dataset.verdict = message.verdict;
    result.done(message);
  }
  else if (message.type === "corrected") result.corrected(message);
  else if (message.type === "unknown") parts.unknown.replaceChildren(...(message.guess ? [guess(message)] : []));
  else if (message.type === "failed") failed(message);
}

export const kept = () => "The recording is kept: the terminal says how the session ended, and how to go on.";

const duration = seconds => (seconds < 60 ? "" : `${Math.floor(seconds / 60)} min `) + `${Math.floor(seconds % 60)} s`;
const sentence = text => inWords(text.charAt(0).toUpperCase() + text.slice(1)) + (/[.?!]$/.test(text) ? "" : ".");

function view(now) {
  const measuring = now.phase === "measuring";
  put(parts.advice, advice(now));
  put(parts.outlook, measuring ? now.outlook : "");
  speak(parts.advice.textContent);
  parts.now.dataset.state = measuring ? now.state : now.phase;
  parts.now.toggleAttribute("data-aside", measuring && Boolean(now.enough) && (tooSimple(now) || now.attitudes.some(each => each.aside)));
  for (const part of parts.later) show(part, now.samples > 0);
  document.title = `${measuring ? now.state : now.phase} · imulab`;
  put(parts.state, now.phase === "failed" ? "ended" : parts.now.dataset.state);
  const away = now.up && now.next && measuring ? Math.round(degreesBetween(now.up, now.next) / 5) * 5 : null;
  parts.ring.draw(parts.now.dataset.state, now.hold, now.hold_needed, away);
  loss(now, measuring);
  show(parts.place, measuring && now.gravity === null && now.samples > 0);
  show(parts.strip.place, measuring);
  if (measuring) parts.strip.draw(now);
  progress(now, measuring);
  bodies(now, measuring);
  facts(now);
  const there = measuring ? now : { ...now, next: null, up: null };
  once("sphere", [there.attitudes, there.next, there.up?.map(each => each.toFixed(2))], () => drawSphere(parts.sphere, there));
  show(parts.marks, measuring);
  once("parameters", [now.parameters, now.targets], () =>
    parts.parameters.replaceChildren(targetList(now), parameterTable(now)));
  once("attitudes", [now.attitudes, measuring], () =>
    parts.attitudes.replaceChildren(attitudeTable(now, measuring ? drop : null)));
  once("knocked", [now.attitudes.filter(each => each.aside), measuring], () => knocked(now, measuring));
  once("warnings", now.warnings, () =>
    parts.warnings.replaceChildren(...now.warnings.map(text => h("p", { class: "said look" }, sentence(text)))));
  once("cause", [now.missing, now.attitudes.map(each => each.number)], () => page.forget());
}

const tooSimple = now => now.warnings.some(text => text.startsWith("the model is too simple"));

export function advice(now) {
  if (now.phase === "computing") return "Computing the record.";
  if (now.phase === "done") return "Done: the record is made.";
  if (now.phase === "failed") return "The session has ended without a record.";
  if (now.outlook) return sentence(now.advice);
  const off = now.attitudes.find(each => each.aside);
  if (now.enough && off) return `Enough, but attitude ${off.number} looks knocked: drop it first.`;
  if (now.enough && tooSimple(now)) return "Enough attitudes, but the model is too simple: see the warning below.";
  if (now.enough && now.state === "accepted") return "Enough: make the record.";
  return sentence(now.advice);
}

// Draws a part anew only where what it shows has changed, so that the focus and a button under the finger stay.
function once(name, value, draw) {
  const text = JSON.stringify(value);
  if (drawn[name] === text) return;
  drawn[name] = text;
  draw();
}

function progress(now, measuring) {
  const count = now.attitudes.length;
  parts.progress.max = Math.max(now.wanted, count, 1);
  parts.progress.value = count;
  put(parts.count, now.wanted ? `${count} of about ${Math.max(now.wanted, count)} attitudes` : `${count} attitudes`);
  put(parts.enough, now.enough ? sentence(now.enough.replace(/^enough: /, "")) : "");
  show(parts.enough, measuring && Boolean(now.enough));
  show(parts.toward, now.phase !== "done");
  show(parts.known, now.phase !== "done" && now.samples > 0);
  show(parts.finish, measuring);
  parts.finish.disabled = Boolean(now.missing);
  put(parts.missing, measuring && now.missing ? `needs ${now.missing}` : "");
  parts.finish.className = now.enough ? "main" : "";
  put(parts.finish, now.enough ? "Make the record" : "Finish now");
}

// The share of samples or bytes that are lost, where it matters.
function loss(now, measuring) {
  const { lost, unread_share: unread } = now.counts, share = Math.max(unread, lost / Math.max(now.samples + lost, 1));
  put(parts.loss, measuring && share >= LOOK ? `${(100 * share).toPrecision(2)} % ${unread ? "of the bytes" : "of the samples"} lost` : "");
  parts.loss.dataset.share = share >= BAD ? "bad" : "look";
}

function bodies(now, measuring) {
  const shown = Boolean(now.up) && (measuring || now.phase === "computing");
  show(parts.bodies, shown);
  show(parts.facts, shown);
  if (!shown) return;
  const wanted = measuring ? now.next : null;
  const key = JSON.stringify(wanted);
  if (!orientation) orientation = upright(now.up);
  if (aim?.key !== key) aim = { key, up: wanted, R: wanted && product(orientation, shortest(wanted, lastUp(now))) };
  orientation = aim.up ? product(aim.R, shortest(now.up, aim.up)) : upright(now.up);
  if (!drag) drawBody(parts.live, orientation);
  parts.live.classList.toggle("by-hand", now.by_hand && measuring);
  show(parts.hand, now.by_hand && measuring);
  show(parts.nextFigure, Boolean(aim.up));
  show(parts.soon, Boolean(aim.up));
  if (!aim.up) {
    put(parts.liveText, "");
    return;
  }
  once("aim", [aim.key, now.next_words], () => {
    drawBody(parts.next, aim.R);
    parts.next.setAttribute("aria-label", `Next attitude: ${now.next_words}`);
    put(parts.nextText, now.next_words);
  });
  const away = degreesBetween(now.up, aim.up);
  put(parts.liveText, away < NEAR ? "this is it" : `${Math.round(away / 5) * 5}° away`);
  parts.liveText.className = away < NEAR ? "there" : "";
}

// A simulated unit is dragged to where it is to turn, and turns there once it is let go.
function byHand(event) {
  if (event.type === "pointerdown" && event.button === 0 && parts.live.classList.contains("by-hand")) {
    parts.live.setPointerCapture(event.pointerId);
    drag = { x: event.clientX, y: event.clientY, R: orientation };
  } else if (drag && event.type === "pointermove") {
    drag.turned = dragged(drag.R, (event.clientX - drag.x) * PER_PIXEL, (event.clientY - drag.y) * PER_PIXEL);
    drawBody(parts.live, drag.turned);
  } else if (drag && event.type !== "pointerdown") {
    if (event.type === "pointerup" && drag.turned) page.send({ type: "turn", up: drag.turned[2] });
    drag = null;
  }
}

// The direction that the drawn orientation has up.
const lastUp = () => orientation[2];

// A refusal of the place stands at the field that it names.
export function wrongPlace(text) {
  const inputs = [...parts.place.querySelectorAll("input")];
  const named = inputs.find(each => text.startsWith(each.name)) || inputs[0];
  for (const each of inputs) each.setAttribute("aria-invalid", String(Boolean(text) && each === named));
  let said = parts.place.querySelector(".wrong");
  if (!said) parts.place.append(said = h("p", { class: "wrong", id: "wrong-place", role: "alert" }));
  named.setAttribute("aria-errormessage", said.id);
  put(said, text.replace(/^place: /, ""));
  show(said, Boolean(text));
  if (text) named.focus();
}

// Asks for the place where nobody stated its gravity, which limits every scale factor.
function placeForm() {
  const field = (name, label, unit, hint) => h("label", {}, label, h("input", { name, inputmode: "decimal", size: 8, placeholder: hint, "aria-label": `${label}, ${unit}` }), unit);
  const fields = { latitude: field("latitude", "Latitude", "°", "48.14"), height: field("height", "height", "m", "520"), gravity: field("gravity", "or gravity", "m/s²", "9.80725") };
  return h("form", {
    class: "said note place", hidden: true,
    onsubmit(event) {
      event.preventDefault();
      wrongPlace("");
      const texts = Object.entries(fields).map(([name, label]) => [name, label.querySelector("input").value.trim()]);
      page.send({ type: "place", ...Object.fromEntries(texts) });
    },
  }, h("p", {}, "Where is this? Without local gravity, scale factors are known to 0.16 % at best."),
  h("span", { class: "fields" }, Object.values(fields), h("button", {}, "Use")));
}

function facts(now) {
  const { gaps, unread_share: unread, ...wrong } = now.counts;
  const rows = [
    ["|f| now, uncorrected", now.length === null ? "–" : `${now.length.toPrecision(5)} ${now.unit.replace("^2", "²")}`],
    ["stream", now.rate ? `${now.rate.toPrecision(3)} Hz` : "–"],
    ["recorded", duration(now.seconds)],
    ...(now.gravity === null ? [] : [["gravity here", `${now.gravity.toFixed(4)} m/s²`]]),
    ...(now.temperature === null ? [] : [["temperature", `${now.temperature.toFixed(1)} °C`]]),
    ...Object.entries(wrong).filter(([, number]) => number).map(([name, number]) => [`samples ${name}`, `${number}`]),
    ...(unread ? [["bytes lost", `${(100 * unread).toPrecision(2)} %`]] : []),
  ];
  if (parts.facts.children.length !== rows.length) {
    parts.facts.replaceChildren(...rows.map(() => h("div", {}, h("dt", {}), h("dd", {}))));
  }
  rows.forEach(([name, text], k) => {
    put(parts.facts.children[k].firstChild, name);
    put(parts.facts.children[k].lastChild, text);
  });
  put(document.getElementById("where"), [now.source, now.format, now.recording].filter(Boolean).join(" · "));
}

function knocked(now, measuring) {
  parts.knocked.replaceChildren(...now.attitudes.filter(each => each.aside && measuring).map(each => {
    const off = each.residual === null ? "" : ` is off by ${milli(each.residual)} mg`;
    return h("p", { class: "said bad" }, `Attitude ${each.number}${off}: knocked? Drop it, or put it down so once more. `,
      h("button", { onclick: () => drop(each.number) }, `Drop attitude ${each.number}`));
  }));
}

const drop = number => page.send({ type: "drop", attitude: number });

function happened(event) {
  parts.log.prepend(h("li", {}, h("span", { class: "time" }, `${event.time.toFixed(1)} s`), ` ${inWords(event.text)}`));
  while (parts.log.children.length > LOG) parts.log.lastChild.remove();
  beep(event.kind);
}

const pre = (label, text) => h("pre", { tabindex: 0, role: "region", "aria-label": label }, text);

// The guess of an unknown stream's columns, which one click takes.
const guess = ({ lines, guess: text }) => h("section", { class: "said note" },
  h("p", {}, "This stream does not say what its columns are. A guess: ", h("button", { class: "main", onclick: () => page.send({ type: "guess" }) }, "Read it so")),
  h("p", {}, "Its first lines:"), pre("Lines of the stream", lines.join("\n")), h("p", {}, "The guess:"), pre("Layout", text), savedLayout(text));
const savedLayout = text => h("p", {}, "To change it, save it, and start again with it as the layout: ",
  h("a", { class: "button", href: URL.createObjectURL(new Blob([text], { type: "application/toml" })), download: "layout.toml" }, "Save layout.toml"));

// The session has ended: what it knew stays on the page.
function failed(message) {
  page.end(sentence(message.missing ? `For a record it needs ${message.missing}` : message.text), "bad");
  parts.unknown.replaceChildren();
  const below = [];
  if (message.kept) below.push(h("p", {}, `${message.kept}.`));
  if (message.missing) below.push(h("details", {}, h("summary", {}, "The reason in full"), h("p", {}, message.text)));
  if (message.lines.length) below.push(h("p", {}, "The first lines of the stream:"), pre("Lines of the stream", message.lines.join("\n")));
  if (message.guess) {
    below.push(h("p", {}, "A guess of its columns:"), pre("Layout", message.guess), savedLayout(message.guess));
  }
  if (below.length) parts.knocked.replaceChildren(h("section", {}, below));
  for (const part of [parts.toward, parts.outlook]) show(part, false);
  for (const button of place.querySelectorAll("button")) button.disabled = true;
}
