// The workbench: recordings are dropped here, seen, calibrated, and left as records.

import { h, put, show } from "./dom.js";
import { form } from "./bench/form.js";
import { card } from "./bench/job.js";
import { address, ask, bytes, send } from "./bench/net.js";
import { plots } from "./bench/plot.js";

export const title = "Workbench";
const READING = ["layout", "units", "topic", "instance", "window", "element"];
const KINDS = { recording: "recording", record: "record", report: "report", manifest: "manifest or layout", folder: "folder", other: "file" };

let page = null;
let place = null;
let files = [];
let folder = "";
let newest = -1;
let clicks = 0;
let forms = [];
let chosen = null;
let opening = null;
let current = null;
let reading = {};
let last = null;
const cards = new Map();
const ui = {};

export function mount(into, given) {
  page = given;
  place = into;
  ui.input = h("input", { type: "file", multiple: true, id: "bench-files", class: "unseen", onchange: () => { take([...ui.input.files]); ui.input.value = ""; } });
  ui.drop = h("label", { class: "drop", for: "bench-files" }, h("strong", {}, "Drop recordings or records here"), h("span", {}, "or choose files"));
  ui.coming = h("ul", { class: "coming", "aria-live": "polite" });
  ui.list = h("ul", { class: "list" });
  ui.where = h("p", { class: "where" });
  ui.try = h("p", { class: "try" }, "Nothing at hand? ", h("button", { type: "button", onclick: simulate }, "Simulate a recording"));
  ui.file = h("section", { class: "file", "aria-label": "The chosen file", hidden: true });
  ui.procedure = h("section", { class: "procedure", "aria-labelledby": "bench-what", hidden: true });
  ui.jobs = h("div", { class: "jobs", "aria-label": "Results", role: "region" });
  place.append(ui.bench = h("div", { class: "bench nothing" },
    h("p", { class: "welcome" }, "See a recording of an inertial sensor, calibrate it, and take the record, the report and the firmware with you."),
    h("div", { class: "side" }, h("div", { class: "droparea" }, ui.input, ui.drop), ui.coming, ui.try, h("nav", { "aria-label": "Files" }, ui.list), ui.where),
    h("div", { class: "work" }, ui.file, ui.procedure, ui.jobs)));
  for (const kind of ["dragover", "drop", "dragleave"]) {
    addEventListener(kind, event => {
      if (place.hidden || ![...(event.dataTransfer?.types || [])].includes("Files")) return;
      event.preventDefault();
      ui.drop.classList.toggle("over", kind === "dragover");
      if (kind === "drop") take([...event.dataTransfer.files]);
    });
  }
  ask("forms").then(found => { forms = found; if (chosen) formed(); }).catch(fail);
}

const fail = error => page.say(error.message, "bad");

export const kept = () => `${folder && files.some(each => each.in_folder) ? `What was dropped and made is in the folder ${folder}. ` : ""}Start imulab again, and open the address that it prints.`;

export function hear(message) {
  if (message.type === "files") listed(message);
  else if (message.type === "opening" && message.file === chosen?.name && JSON.stringify(message.reading) === JSON.stringify(reading)) opened(message);
  else if (message.type === "job") worked(message);
}

// A file is not read before somebody looks, and a session beside this may have written others.
export function shown() {
  ask("files").then(listed).catch(fail);
}

// What has come is shown, unless another file was clicked on meanwhile.
async function take(given) {
  const before = clicks;
  for (const file of given) {
    const part = h("progress", { max: 1, value: 0, "aria-label": `receiving ${file.name}` });
    const row = h("li", {}, file.name, part);
    ui.coming.append(row);
    try {
      const name = await send(file, gone => { part.value = gone; });
      if (!files.some(each => each.name === name)) listed(await ask("files"));
      if (clicks === before && chosen?.name !== name) choose(name);
    } catch (error) {
      fail(error);
    }
    row.remove();
  }
}

function listed(message) {
  if (message.number < newest) return; // an answer that a later message has overtaken
  ({ files, folder, number: newest } = message);
  const row = each => h("li", {}, h("button", {
    type: "button", class: "entry", "aria-current": each.name === chosen?.name ? "true" : null, "data-name": each.name, onclick: () => { clicks += 1; choose(each.name); },
  }, h("span", { class: "filename" }, each.short), h("span", { class: "kind" }, `${KINDS[each.kind]}${each.kind === "folder" ? "" : `, ${bytes(each.size)}`}`)));
  const focused = document.activeElement?.dataset?.name;
  ui.list.replaceChildren(...files.map(row));
  if (focused) [...ui.list.querySelectorAll("button")].find(each => each.dataset.name === focused)?.focus();
  ui.bench.classList.toggle("nothing", !files.length && !cards.size);
  show(ui.try, !files.some(each => each.kind === "recording"));
  put(ui.where, files.length ? `What is dropped or made is kept in the folder ${folder}.` : "");
  if (chosen && !files.some(each => each.name === chosen.name)) leave();
  else if (!chosen && files.length && !place.hidden) choose((files.find(each => each.kind === "recording") || files[0]).name);
  current?.refresh();
}

function leave() {
  chosen = null;
  show(ui.file, false);
  listed({ files, folder, number: newest });
}

function choose(name) {
  chosen = files.find(each => each.name === name) || null;
  if (!chosen) return;
  for (const each of ui.list.querySelectorAll("button")) {
    if (each.dataset.name === name) each.setAttribute("aria-current", "true");
    else each.removeAttribute("aria-current");
  }
  opening = null;
  reading = {};
  ({ recording: recording, record: record }[chosen.kind] || other)();
  show(ui.file, true);
  offer();
}

const heading = () => h("div", { class: "heading" }, h("h2", {}, chosen.short),
  h("span", { class: "actions" },
    h("a", { class: "button", href: address(chosen.kind === "folder" ? "zip" : "files", chosen.name), download: "" }, chosen.kind === "folder" ? "Save as zip" : "Save"),
    chosen.in_folder && chosen.kind !== "folder" ? h("button", { type: "button", onclick: remove }, "Remove") : null));

function remove() {
  if (confirm(`Remove ${chosen.short} from the folder ${folder}?`)) {
    ask(`files/${encodeURIComponent(chosen.name)}`, undefined, { method: "DELETE" }).catch(fail);
  }
}

// What a file shows that is made of forms; a recording that is shown already stays as it is.
function formed() {
  if (chosen.kind === "record") record();
  else if (chosen.kind === "recording") ui.reading.replaceChildren(ui.reading.firstChild, readingForm());
  offer();
}

function recording() {
  ui.summary = h("p", { class: "message", role: "status" }, "reading…");
  ui.refused = h("p", { class: "refused", role: "alert", hidden: true });
  ui.reading = h("details", { class: "more" }, h("summary", {}, "How the file is read"), readingForm());
  ui.head = h("details", { class: "more" }, h("summary", {}, "What the file says of itself"));
  const area = h("div", {});
  ui.file.replaceChildren(heading(), ui.summary, ui.refused, area, ui.head, ui.reading);
  ui.plots = plots(area);
  open();
}

// The same options of reading as every command has.
function readingForm() {
  const convert = forms.find(each => READING.every(name => each.fields.some(field => field.name === name)));
  if (!convert) return h("p", {});
  const inputs = convert.fields.filter(each => READING.includes(each.name)).map(each => {
    const input = h("input", { type: "text", id: `reading-${each.name}`, placeholder: each.shows, value: reading[each.name] || null, spellcheck: "false", autocomplete: "off" });
    return { each, input, element: h("div", { class: "field" }, h("label", { for: input.id }, each.name), input, h("small", {}, each.help)) };
  });
  return h("form", { onsubmit: event => {
    event.preventDefault();
    reading = Object.fromEntries(inputs.map(({ each, input }) => [each.name, input.value.trim()]).filter(([, text]) => text));
    open();
    offer();
  } }, h("div", { class: "fields" }, inputs.map(each => each.element)), h("p", { class: "go" }, h("button", { type: "submit" }, "Read it so")));
}

function open() {
  const name = chosen.name;
  opening = null;
  const own = reading;
  const here = () => chosen?.name === name && reading === own;
  ask("open", { file: name, reading }).then(found => { if (here() && !opening) opened(found); }).catch(error => { if (here()) opened({ error: error.message }); });
}

function opened(message) {
  opening = message;
  const head = message.head;
  const error = message.error;
  put(ui.refused, error || "");
  show(ui.refused, Boolean(error));
  if (error && !head?.rows) {
    put(ui.summary, "This file cannot be read as it is.");
    ui.reading.open = true;
    ui.plots.close();
    return;
  }
  put(ui.summary, head ? `${error ? "Read up to where it breaks: " : ""}${summary(message)}` : "reading…");
  const notes = [...(message.notes || []), ...(message.unknown ? [message.unknown] : [])];
  const told = Object.entries(message.metadata || {}).map(([key, value]) => `${key}: ${value}`);
  show(ui.head, notes.length + told.length > 0);
  if (message.done) {
    ui.head.replaceChildren(ui.head.firstChild, ...(notes.length ? [h("ul", {}, notes.map(each => h("li", {}, each)))] : []), h("pre", {}, told.join("\n")));
  }
  ui.plots.open(message);
}

function summary({ head, done, attitudes }) {
  const parts = [`${head.rows.toLocaleString("en").replaceAll(",", " ")} samples`];
  if (!done) return `reading… ${parts[0]} so far`;
  if (head.timed) {
    const seconds = head.last - head.first;
    if (head.rows > 1 && head.usual > 0) parts.push(`${seconds.toPrecision(4)} s at ${Number((1 / head.usual).toPrecision(4))} Hz`);
    parts.push(head.gap_count ? `${head.gap_count} ${head.gap_count === 1 ? "gap" : "gaps"}` : "no gaps");
    if (attitudes === undefined) parts.push("looking for attitudes…");
    else if (attitudes.length) parts.push(`${attitudes.length} ${attitudes.length === 1 ? "attitude" : "attitudes"} at rest (shaded)`);
  } else {
    parts.push("no rising time: shown by row");
  }
  return parts.join(", ");
}

const start = (command, values) => ask("jobs", { command, values }).then(worked);

// A record: what it says, its report, firmware and other programs' files, and what changed since another.
function record() {
  const name = chosen.name;
  const targets = forms.find(each => each.path === "export")?.fields.find(each => each.name === "to")?.choices || [];
  const others = files.filter(each => each.kind === "record" && each.name !== name);
  const act = (label, run, kind) => h("button", { type: "button", class: kind, onclick: () => run().catch(fail) }, label);
  const pick = (label, words, run) => {
    const select = h("select", { "aria-label": label }, words.map(([value, text]) => h("option", { value }, text)));
    return h("span", { class: "pick" }, select, act(label, () => run(select.value)));
  };
  ui.file.replaceChildren(heading(), h("p", { class: "message" }, "A calibration record. Take it to the unit, or look at what it holds:"),
    h("div", { class: "actions wide" },
      act("Report", () => start("report", { file: name, output: true }), "main"),
      act("What it says", () => start("show", { files: [name] })),
      act("Firmware (zip)", () => start("export", { records: [name], to: "c", output: true })),
      pick("Write for another program", targets.filter(each => each !== "c").map(each => [each, each]), to => start("export", { records: [name], to, output: true })),
      others.length ? pick("Compare with it", others.map(each => [each.name, each.short]), to => start("show", { files: [to, name] })) : null));
}

function other() {
  ui.file.replaceChildren(heading(), h("p", { class: "message" }, { report: "A report: save it to open it in the browser.", folder: "What a command has written, as a folder.", manifest: "A manifest or a layout: choose it in a form below." }[chosen.kind] || "A file that imulab does not read by itself."));
}

function simulate() {
  start("tumble simulate", { output: "tumble.csv" }).catch(() => start("tumble simulate", { output: true }).catch(fail));
}

// What can be done, with a form for it.
function offer() {
  if (!forms.length || !chosen) { show(ui.procedure, false); return; }
  const takes = (each, what) => each.fields.some(field => (!field.flag || field.required) && field.kind.startsWith("file") && what.test(field.shows));
  const suits = each => chosen.kind === "record" ? takes(each, /RECORD|FILE \[/) : takes(each, /FILE|LOG|STILL|MANIFEST/);
  const order = [...forms].sort((one, other) => rank(one) - rank(other));
  const free = order.filter(each => each.fields.every(field => field.flag));
  const groups = new Map([["With this file", order.filter(each => suits(each) && !free.includes(each))], ["Plan and simulate", free]]);
  const known = [...groups.values()].flat();
  const wanted = known.find(each => each.path === last) || known[0];
  const select = h("select", { id: "bench-procedure", onchange: () => { last = select.value; fill(order.find(each => each.path === last)); } },
    [...groups].map(([label, found]) => h("optgroup", { label }, found.map(each => h("option", { value: each.path, selected: each === wanted }, `${each.path}: ${each.summary.replace(/\.$/, "")}`)))));
  ui.form = h("div", {});
  ui.procedure.replaceChildren(h("h2", { id: "bench-what" }, "What to do"), h("div", { class: "field wide" }, h("label", { for: "bench-procedure" }, "procedure"), select), ui.form);
  show(ui.procedure, true);
  fill(wanted);
}

// Fits first, then what needs one file, then what needs a record too.
const rank = each => (/ (fit|calibrate|reduce)$/.test(each.path) ? 0 : 1 + each.fields.filter(field => !field.flag || field.required).length);

// The chosen file and the latest record go where they fit.
function fill(definition) {
  const latest = kind => (chosen.kind === kind ? chosen : files.filter(each => each.kind === kind).sort((one, other) => other.modified - one.modified)[0])?.name;
  const values = { ...reading };
  for (const each of definition.fields.filter(found => (!found.flag || found.required) && found.kind.startsWith("file"))) {
    const fitting = [/RECORD/.test(each.shows) ? latest("record") : null, /RECORD(\.\.\.)?$/.test(each.shows) ? null : chosen.kind === "record" && each.shows.includes("RECORD") ? latest("recording") : chosen.name].filter(Boolean);
    values[each.name] = each.kind === "files" ? fitting : fitting[0];
  }
  current = form(definition, { files: () => files, values, run: async given => { last = definition.path; await start(definition.path, given); } });
  ui.form.replaceChildren(current.element);
}

function worked(job) {
  const known = cards.get(job.number);
  if (known) {
    known.update(job);
  } else {
    const found = card(job, { look: name => { choose(name); ui.file.scrollIntoView({ block: "start" }); }, kind: name => files.find(each => each.name === name)?.kind });
    for (const each of ui.jobs.children) each.open = false;
    cards.set(job.number, found);
    ui.jobs.prepend(found.element);
    if (Date.now() / 1000 - job.began < 5) found.element.scrollIntoView({ block: "start" });
  }
  if (job.ended !== null && !chosen) {
    const made = job.outputs.find(name => files.some(each => each.name === name && each.kind === "recording"));
    if (made) choose(made);
  }
}
