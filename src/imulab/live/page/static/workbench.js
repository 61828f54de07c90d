// The workbench: files, what is in one, what can be done with it, and what was done.
//
// What is shown stands in the address (bench/state.js): the file, those chosen with it, the procedure, the range.

import { h, put, redraw, show, unpressed } from "./dom.js";
import { columnTable, layoutList } from "./bench/columns.js";
import { form } from "./bench/form.js";
import { card, from } from "./bench/job.js";
import { alike, fileList, kindOf } from "./bench/list.js";
import { address, ask, askOnce, send } from "./bench/net.js";
import { plots } from "./bench/plot.js";
import { inAddress, keep, recall, toAddress } from "./bench/state.js";
import { likely, reason } from "./bench/suits.js";
import { grouped, written } from "./bench/units.js";

export const title = "Workbench";
const NOTHING = new Set(["folder", "report", "other", "settings", "layout"]); // kinds of files that no command is for
const READING = ["units", "topic", "instance", "window", "element", "damaged"];

let page = null;
let place = null;
let files = [];
let folder = "";
let newest = -1;
let clicks = 0;
let forms = [];
let shipped = [];
let chosen = null;
let others = []; // names of further files that are chosen
let opening = null;
let current = null; // the form that is shown
let procedure = null;
let reading = {};
let range = [null, null];
let offered = "";
let filled = "";
const cards = new Map();
const ui = {};

export function mount(into, given) {
  page = given;
  place = into;
  ui.input = h("input", { type: "file", multiple: true, id: "bench-files", class: "unseen", onchange: () => { take([...ui.input.files]); ui.input.value = ""; } });
  ui.drop = h("label", { class: "drop", for: "bench-files" }, h("strong", {}, "Drop recordings or records here"), h("span", {}, "or choose files"));
  ui.coming = h("ul", { class: "coming", "aria-live": "polite" });
  ui.list = fileList({ choose: name => { clicks += 1; pick(name); }, toggle, redraw: () => ui.list.draw(files, chosen?.name, others) });
  ui.where = h("p", { class: "where" });
  ui.try = h("p", { class: "try" }, "Nothing at hand? ", h("button", { type: "button", onclick: simulate }, "Simulate a recording"));
  ui.file = h("section", { class: "file", "aria-label": "The chosen file", hidden: true });
  ui.form = h("div", { class: "formplace" });
  ui.procedure = h("section", { class: "procedure", "aria-labelledby": "bench-what", hidden: true },
    ui.what = h("h2", { id: "bench-what" }), ui.fits = h("div", { class: "cards" }), ui.form, ui.more = h("div", {}));
  ui.jobs = h("div", { class: "jobs", "aria-label": "Results", role: "region" });
  ui.clear = h("p", { class: "clear", hidden: true }, h("button", { type: "button", onclick: () => ask("results", undefined, { method: "DELETE" }).catch(fail) }, "Clear the list of results"), " What they made stays.");
  ui.status = h("p", { class: "statusline", role: "status", hidden: true });
  place.append(ui.bench = h("div", { class: "bench nothing" },
    h("p", { class: "welcome" }, "See a recording of an inertial sensor, calibrate it, and take the record, the report and the firmware with you."),
    h("div", { class: "side" }, h("div", { class: "droparea" }, ui.input, ui.drop), ui.coming, ui.try, ui.list.element, ui.where),
    h("div", { class: "work" }, ui.file, ui.jobs, ui.clear, ui.procedure, ui.status)));
  for (const kind of ["dragover", "drop", "dragleave"]) {
    addEventListener(kind, event => {
      if (place.hidden || ![...(event.dataTransfer?.types || [])].includes("Files")) return;
      event.preventDefault();
      ui.drop.classList.toggle("over", kind === "dragover");
      if (kind === "drop") take([...event.dataTransfer.files]);
    });
  }
  addEventListener("popstate", follow);
  Promise.all([ask("forms"), ask("layouts")]).then(found => { [forms, shipped] = found; if (chosen) formed(); else offer(); }).catch(fail);
}

const fail = error => page.say(error.message, "bad");

export const kept = () => `${folder && files.some(each => each.in_folder) ? `What was dropped and made is in the folder ${folder}. ` : ""}Start imulab again, and open the address that it prints.`;

export async function hear(message) {
  await unpressed();
  if (message.type === "files") listed(message);
  else if (message.type === "opening" && message.file === chosen?.name && JSON.stringify(message.reading) === JSON.stringify(reading)) opened(message);
  else if (message.type === "job") worked(message);
  else if (message.type === "cleared") cleared(message.numbers);
}

// A file is not read before somebody looks, and a session beside this may have written others.
export function shown() {
  ask("files").then(listed).catch(fail);
}

// Files

// What has come is shown, unless another file was clicked on meanwhile; of many, the first, and the others are chosen too.
async function take(given) {
  const before = clicks;
  const came = [];
  for (const file of given) {
    const part = h("progress", { max: 1, value: 0, "aria-label": `receiving ${file.name}` });
    const row = h("li", {}, file.name, part);
    ui.coming.append(row);
    try {
      const { name, replaced } = await send(file, gone => { part.value = gone; });
      came.push(name);
      if (!files.some(each => each.name === name)) listed(await ask("files"));
      if (replaced) page.say(`${file.name} has been replaced by what came now; results of the older one say so.`);
      if (clicks === before && came.length === 1) arrived(name, replaced);
    } catch (error) {
      fail(error);
    }
    row.remove();
  }
  const first = files.find(each => each.name === came[0]);
  if (clicks === before && came.length > 1 && first && chosen === first) {
    pick(first.name, { others: came.slice(1).filter(name => files.find(each => each.name === name)?.kind === first.kind) });
  }
}

// A layout that comes while a file cannot be read is meant for that file.
function arrived(name, replaced) {
  const entry = files.find(each => each.name === name);
  if (entry?.kind === "layout" && chosen?.kind === "recording" && opening?.error) readSo({ ...reading, layout: name });
  else if (chosen?.name !== name) pick(name);
  else if (replaced) choose(name, { others, procedure });
}

function listed(message) {
  if (message.number < newest) return; // an answer that a later message has overtaken
  ({ files, folder, number: newest } = message);
  const known = new Set(files.map(each => each.name));
  others = others.filter(name => known.has(name));
  ui.list.draw(files, chosen?.name, others);
  ui.bench.classList.toggle("nothing", !files.length && !cards.size);
  show(ui.try, !files.some(each => each.kind === "recording"));
  put(ui.where, files.length ? `What is dropped or made is kept in the folder ${folder}.` : "");
  if (chosen && !known.has(chosen.name)) leave();
  else if (chosen) chosen = files.find(each => each.name === chosen.name);
  else if (files.length && !place.hidden) begin();
  current?.refresh();
  offer();
}

// The first file that is shown: that of the address, or the first recording.
function begin() {
  const wanted = inAddress();
  if (files.some(each => each.name === wanted.file)) choose(wanted.file, wanted);
  else pick((files.find(each => each.kind === "recording" && !each.folder) || files.find(each => actions.holds(each.name)) || files[0]).name, {}, false);
}

function leave() {
  chosen = null;
  others = [];
  ui.file.replaceChildren(h("p", { class: "message" }, "Choose a file in the list, or drop another one."));
  show(ui.file, files.length > 0);
  ui.list.draw(files, null, []);
  offer();
}

// Back and forward.
function follow() {
  const wanted = inAddress();
  if (!files.some(each => each.name === wanted.file)) return;
  if (wanted.file === chosen?.name && wanted.others.join() === others.join()) {
    ui.plots?.follow(wanted.range);
    range = wanted.range;
    if (wanted.procedure !== procedure) { procedure = wanted.procedure; keep("procedure", chosen.name, procedure); offered = ""; offer(); }
  } else {
    choose(wanted.file, wanted);
  }
}

// A file that was asked for: a folder opens with all that is in it.
function pick(name, more = {}, step = true) {
  const entry = files.find(each => each.name === name);
  const inside = entry?.kind === "folder" ? files.filter(each => each.folder === name) : [];
  const manifest = inside.find(each => ["rate", "centrifuge"].includes(each.kind));
  const first = manifest || inside.find(each => each.kind === "recording") || inside[0];
  if (!first) choose(name, more);
  else choose(first.name, { ...more, others: manifest ? [] : inside.filter(each => each.kind === first.kind && each !== first).map(each => each.name) });
  if (chosen) say(step);
}

const say = step => toAddress({ file: chosen.name, others, procedure, range }, step);

function toggle(names, on) {
  others = others.filter(each => !names.includes(each));
  if (on) others.push(...names.filter(each => each !== chosen.name));
  others = files.map(each => each.name).filter(each => others.includes(each));
  ui.list.draw(files, chosen.name, others);
  ui.heading?.replaceWith(ui.heading = heading());
  say(false);
  offered = "";
  offer();
}

function choose(name, more = {}) {
  chosen = files.find(each => each.name === name) || null;
  if (!chosen) return;
  others = more.others || [];
  procedure = "procedure" in more ? more.procedure : recall("procedure", name) || null;
  range = more.range || [null, null];
  reading = { ...recall("reading", name) };
  ui.list.draw(files, name, others);
  opening = null;
  offered = filled = "";
  for (const each of ui.jobs.children) if (!(each.files || []).includes(name)) each.open = false;
  ({ recording: recording, record: record }[chosen.kind] || other)();
  show(ui.file, true);
  offer();
}

// The name, how many are chosen with it, and what can be done with the file itself.
function heading() {
  const same = chosen.kind === "recording" || chosen.kind === "record" ? alike(files, chosen).map(each => each.name) : [];
  const left = same.filter(each => each !== chosen.name && !others.includes(each));
  return h("div", { class: "heading" }, h("h2", {}, chosen.short, others.length ? h("span", { class: "count" }, ` and ${grouped(others.length)} more`) : null),
    h("span", { class: "actions" },
      left.length ? h("button", { type: "button", onclick: () => toggle(same, true) }, `Choose all ${grouped(same.length)} like this`) : null,
      others.length ? h("button", { type: "button", onclick: () => toggle([...others], false) }, "Only this one") : null,
      h("a", { class: "button", href: address(chosen.kind === "folder" ? "zip" : "files", chosen.name), download: "" }, chosen.kind === "folder" ? "Save as zip" : "Save"),
      chosen.folder ? h("a", { class: "button", href: address("zip", chosen.folder), download: "" }, "Save the folder") : null,
      chosen.in_folder && chosen.kind !== "folder" ? h("button", { type: "button", onclick: remove }, "Remove") : null));
}

function remove() {
  if (confirm(`Remove ${chosen.short} from the folder ${folder}?`)) {
    askOnce(`files/${encodeURIComponent(chosen.name)}`, undefined, { method: "DELETE" }).catch(fail);
  }
}

// What a file shows that is made of forms; a recording that is shown already stays as it is.
function formed() {
  if (chosen.kind === "record") record();
  else if (chosen.kind === "recording") drawReading();
  offered = "";
  offer();
}

// A recording

function recording() {
  ui.summary = h("p", { class: "message", role: "status" }, "reading…");
  ui.refused = h("p", { class: "refused", role: "alert", hidden: true });
  ui.columns = h("div", {});
  ui.reading = h("details", { class: "more howread" }, h("summary", {}, "How the file is read"), h("div", {}));
  ui.head = h("details", { class: "more" }, h("summary", {}, "What the file says of itself"));
  const area = h("div", {});
  ui.file.replaceChildren(ui.heading = heading(), ui.summary, ui.refused, ui.columns, area, ui.head, ui.reading);
  ui.plots = plots(area, {
    begin: () => range,
    ranged: wanted => { range = wanted; say(false); },
    use: ends => {
      const text = ends.map(each => written(each, 7).replace("−", "-")).join(":");
      if (current?.set("window", text)) ui.form.scrollIntoView({ block: "start" });
      else readSo({ ...reading, window: text });
    },
  });
  drawReading();
  open();
}

// Layouts, columns, and the same options of reading as every command has.
function drawReading() {
  const body = ui.reading.lastChild;
  const convert = forms.find(each => READING.every(name => each.fields.some(field => field.name === name)));
  if (!convert) return;
  const inputs = convert.fields.filter(each => READING.includes(each.name)).map(each => {
    const input = h("input", { type: "text", id: `reading-${each.name}`, value: reading[each.name] || null, spellcheck: "false", autocomplete: "off" });
    return { each, input, element: h("div", { class: "field" }, h("label", { for: input.id }, each.name), input, h("small", {}, each.help)) };
  });
  const now = reading.layout ? files.find(each => each.name === reading.layout)?.short || reading.layout : "";
  body.replaceChildren(
    h("p", { class: "message" }, now ? `Read with the layout ${now}. ` : "Read as its format and its titles say. ",
      now ? h("button", { type: "button", onclick: () => readSo({ ...reading, layout: "" }) }, "Read it without") : null, " ",
      h("button", { type: "button", onclick: () => state(true) }, "Say what its columns are")),
    layoutList(files.filter(each => each.kind === "layout"), shipped, reading.layout, name => readSo({ ...reading, layout: name })),
    h("form", { onsubmit: event => {
      event.preventDefault();
      readSo({ layout: reading.layout || "", ...Object.fromEntries(inputs.map(({ each, input }) => [each.name, input.value.trim()])) });
    } }, h("div", { class: "fields" }, inputs.map(each => each.element)), h("p", { class: "go" }, h("button", { type: "submit" }, "Read it so"))));
}

function readSo(wanted, only = false) {
  reading = Object.fromEntries(Object.entries(wanted).filter(([, text]) => text));
  range = [null, null];
  if (!only) {
    for (const name of [chosen.name, ...others]) keep("reading", name, reading);
    ui.columns.replaceChildren();
    drawReading();
    offered = "";
  }
  open();
  if (!only) offer();
}

// The table in which a person says what the columns are.
async function state(asked) {
  const file = chosen;
  try {
    const told = await ask("columns", { file: file.name });
    if (chosen !== file && chosen?.name !== file.name) return;
    const table = columnTable(file, told, {
      // An answer may come when another file is looked at, which it must not be read by.
      preview: layout => { if (table.element.isConnected) readSo({ ...reading, layout }, true); },
      saved: layout => { if (table.element.isConnected) { readSo({ ...reading, layout }); ui.file.scrollIntoView({ block: "start" }); } },
    });
    ui.columns.replaceChildren(table.element);
    put(ui.summary, "This file does not say itself what is in it.");
    show(ui.refused, false);
    table.begin();
    if (asked) ui.columns.scrollIntoView({ block: "nearest" });
  } catch (error) {
    if (chosen?.name !== file.name) return;
    if (asked) { put(ui.refused, error.message); show(ui.refused, true); }
    else ui.reading.open = true;
  }
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
  const { head, error } = message;
  const stating = Boolean(ui.columns.firstChild);
  const some = Boolean(head?.rows);
  put(ui.refused, error || "");
  show(ui.refused, Boolean(error) && (some || !stating));
  if (error && !some) {
    put(ui.summary, "This file cannot be read as it is.");
    ui.plots.close();
    if (!stating) state(false);
    offer();
    return;
  }
  put(ui.summary, head ? `${error ? "Read up to where it breaks: " : ""}${summary(message)}` : "reading…");
  const notes = [...(message.notes || []), ...(message.unknown ? [message.unknown] : [])];
  const told = Object.entries(message.metadata || {}).map(([key, value]) => `${key}: ${value}`);
  show(ui.head, notes.length + told.length > 0);
  if (message.done) {
    ui.head.replaceChildren(ui.head.firstChild, ...(notes.length ? [h("ul", {}, notes.map(each => h("li", {}, each)))] : []), h("pre", { tabindex: 0, "aria-label": "metadata of the file" }, told.join("\n")));
  }
  ui.plots.open(message);
  offer();
}

function summary({ head, done, attitudes, turned }) {
  const parts = [`${grouped(head.rows)} samples`];
  if (!done) return `reading… ${parts[0]} so far`;
  if (head.timed) {
    const seconds = head.last - head.first;
    if (head.rows > 1 && head.usual > 0) parts.push(`${seconds.toPrecision(4)} s at ${Number((1 / head.usual).toPrecision(4))} Hz`);
    parts.push(head.gap_count ? `${head.gap_count} ${head.gap_count === 1 ? "gap" : "gaps"}` : "no gaps");
    if (attitudes === undefined) parts.push("looking for attitudes…");
    else if (attitudes.length > 1 && !turned) parts.push(`never turned, ${attitudes.length} stretches at rest (shaded)`);
    else if (attitudes.length) parts.push(`${attitudes.length} ${attitudes.length === 1 ? "attitude" : "attitudes"} at rest (shaded)`);
  } else {
    parts.push("no rising time: shown by row");
  }
  return parts.join(", ");
}

// A record, and other files

// Folds the settings of a command, or opens them again.
function fold(path, away) {
  const settings = ui.form.querySelector("details.settings");
  if (settings?.querySelector("summary").textContent === path) settings.open = !away;
}

// What is started here is shown at once, and its settings fold away, unless it has been refused by now.
const start = (command, values) => askOnce("jobs", { command, values }).then(job => {
  if (!cards.has(job.number)) worked(job); // else a message was first
  const started = cards.get(job.number);
  fold(job.path, !started?.failed());
  started?.element.scrollIntoView({ block: "start" }); // it may have been cleared by now
});
const targets = () => (forms.find(each => each.path === "export")?.fields.find(each => each.name === "to")?.choices || []).filter(each => each !== "c");

function record() {
  const name = chosen.name;
  const beside = files.filter(each => each.kind === "record" && each.name !== name);
  const act = (label, run, kind) => h("button", { type: "button", class: kind, onclick: () => run().catch(fail) }, label);
  const pickOne = (label, words, run) => {
    const select = h("select", { "aria-label": label }, words.map(([value, text]) => h("option", { value }, text)));
    return h("span", { class: "pick" }, select, act(label, () => run(select.value)));
  };
  ui.file.replaceChildren(ui.heading = heading(), h("p", { class: "message" }, `A calibration ${kindOf(chosen)}. Take it to the unit, or look at what it holds:`),
    h("div", { class: "actions wide" },
      act("Report", () => start("report", { file: name, output: true }), "main"),
      act("What it says", () => start("show", { files: [name] })),
      act("Firmware (zip)", () => start("export", { records: [name], to: "c", output: true })),
      pickOne("Write for another program", targets().map(each => [each, each]), to => start("export", { records: [name], to, output: true })),
      beside.length ? pickOne("Compare with it", beside.map(each => [each.name, each.short]), to => start("show", { files: [to, name] })) : null));
}

function other() {
  const says = {
    report: "A report: save it to open it in the browser.", folder: "What a command has written, as a folder.",
    rate: "The manifest of a rate test: it names the recordings, and what the table did.", centrifuge: "The manifest of a centrifuge test: it names the runs.",
    layout: "A layout: choose it for a recording, under “How the file is read”.", settings: "Settings of a command: choose it in a form.",
  };
  ui.file.replaceChildren(ui.heading = heading(), h("p", { class: "message" }, says[chosen.kind] || "A file that imulab does not read by itself."));
}

function simulate() {
  start("tumble simulate", { output: "tumble.csv" }).catch(() => start("tumble simulate", { output: true }).catch(fail));
}

// What can be done

function facts() {
  return {
    kind: chosen.kind, procedure: chosen.procedure, count: 1 + others.length, known: Boolean(opening?.head?.rows),
    columns: Object.keys(opening?.head?.units || {}), timed: Boolean(opening?.head?.timed), attitudes: opening?.attitudes ? opening.attitudes.length : null, turned: opening?.turned,
    records: files.filter(each => each.kind === "record").map(each => each.procedure),
  };
}

// Cards: those for this file, those that are not and why, and what needs no file.
function offer() {
  // Before it is known what a recording holds, nothing is offered; while it is read anew, what was offered stays.
  const unread = chosen?.kind === "recording" && (ui.columns.firstChild || (opening ? opening.error && !opening.head?.rows : !filled));
  if (!forms.length || unread || (chosen ? NOTHING.has(chosen.kind) : files.length)) {
    show(ui.procedure, false);
    current = null;
    offered = filled = "";
    return;
  }
  const known = chosen ? facts() : {}; // without any file, a test can be planned and simulated
  const key = JSON.stringify([chosen?.name, others, known, reading]);
  if (key === offered) return; // what was typed stays
  offered = key;
  const taking = !chosen ? [] : forms.filter(each => each.fields.some(field => !field.flag) && each.path !== "layout guess");
  const found = taking.map(each => ({ each, why: reason(each.path, known) }));
  const fits = found.filter(({ why }) => !why).map(({ each }) => each).sort((one, other) => likely(one.path, other.path, known));
  const free = forms.filter(each => each.fields.every(field => field.flag));
  const wanted = [...fits, ...free].find(each => each.path === procedure) || (known.kind === "recording" || known.kind === "rate" || known.kind === "centrifuge" ? fits[0] : null);
  const button = (each, why) => h("button", {
    type: "button", class: "card", disabled: Boolean(why), "data-path": each.path, "aria-pressed": why ? null : String(each === wanted), onclick: () => choosing(each),
  }, h("strong", {}, each.path), h("span", {}, why ? `${why[0].toUpperCase()}${why.slice(1)}.` : `${each.summary}.`));
  const unfolded = [...ui.more.children].filter(each => each.open).map(each => each.dataset.label);
  const more = (label, items) => (items.length ? [h("details", { class: "more", "data-label": label, open: unfolded.includes(label) }, h("summary", {}, `${label} (${items.length})`), h("div", { class: "cards" }, items))] : []);
  const focused = document.activeElement?.dataset.path;
  put(ui.what, !chosen ? "Or plan a test, and simulate it" : others.length ? `What to do with these ${grouped(1 + others.length)} files` : "What to do with it");
  redraw(ui.fits, fits.map(each => button(each)));
  redraw(ui.more, [...more("Not with this", found.filter(({ why }) => why).map(({ each, why }) => button(each, why))), ...more("Plan and simulate", free.map(each => button(each)))]);
  show(ui.procedure, true);
  if (focused) ui.procedure.querySelector(`[data-path="${focused}"]`)?.focus();
  if (wanted && filled === formKey(wanted)) current.refresh();
  else if (wanted) fill(wanted);
  else { ui.form.replaceChildren(); current = null; filled = ""; }
}

// The form of these files as they are read: while it is the same, what is typed and folded stays.
const formKey = definition => JSON.stringify([definition.path, chosen?.name, others, reading]);
const press = definition => { for (const each of ui.procedure.querySelectorAll(".card:enabled")) each.setAttribute("aria-pressed", String(each.dataset.path === definition.path)); };

function choosing(definition) {
  noted(definition, true);
  fill(definition);
  ui.form.scrollIntoView({ block: "nearest" });
}

// Notes the procedure, in the address too, as a step or not.
function noted(definition, step) {
  procedure = definition.path;
  if (!chosen) return;
  keep("procedure", chosen.name, procedure);
  say(step);
}

// The chosen files and the latest record go where they fit; what was typed for this file before stands again.
function fill(definition, given = {}) {
  press(definition);
  filled = formKey(definition);
  const suitable = each => reason(definition.path, { ...facts(), kind: "record", procedure: each.procedure }) === "";
  const latest = kind => (chosen?.kind === kind ? chosen : files.filter(each => each.kind === kind && (kind !== "record" || suitable(each))).sort((one, other_) => other_.modified - one.modified)[0])?.name;
  const all = chosen ? [chosen.name, ...others] : [];
  const key = `${chosen?.name}|${definition.path}`;
  const read = Object.fromEntries(Object.entries(reading).filter(([name]) => definition.fields.some(each => each.name === name)));
  const values = { ...read, ...recall("values", key), ...given };
  for (const each of definition.fields.filter(found => (!found.flag || found.required) && found.kind.startsWith("file"))) {
    if (values[each.name]) continue;
    const fitting = [/RECORD/.test(each.shows) ? [latest("record")] : [], /RECORD(\.\.\.)?$/.test(each.shows) ? [] : chosen?.kind === "record" && each.shows.includes("RECORD") ? [latest("recording")] : all].flat().filter(Boolean);
    values[each.name] = each.kind === "files" ? fitting : fitting[0];
  }
  current = form(definition, {
    files: () => files, values,
    keep: typed => {
      keep("values", key, typed);
      if (!procedure && Object.keys(typed).length) noted(definition, false); // no likelier one takes its place
    },
    run: async typed => {
      if (filled === formKey(definition)) noted(definition, false); // another file may be shown by now
      await start(definition.path, typed);
    },
  });
  ui.form.replaceChildren(h("details", { class: "settings", open: true }, h("summary", {}, h("strong", {}, definition.path)), current.element));
}

// What was done

const actions = {
  look: name => { clicks += 1; pick(name); ui.file.scrollIntoView({ block: "start" }); },
  kind: name => files.find(each => each.name === name)?.kind,
  holds: name => files.some(each => each.folder === name),
  targets,
  can: path => forms.some(each => each.path === path),
  export: (name, to, more) => start("export", { records: [name], to, output: true, ...more }).catch(fail),
  again: job => {
    const records = job.words.slice(1).filter(word => files.some(each => each.name === word));
    start("export", { records, to: job.words[job.words.indexOf("--to") + 1], lossy: true, output: true }).catch(fail);
  },
  // The form of what a record is for, with the recording that is shown.
  form: (path, name) => {
    const definition = forms.find(each => each.path === path);
    const recording_ = (chosen?.kind === "recording" ? chosen : files.find(each => each.kind === "recording"))?.name;
    const records = definition.fields.filter(each => each.kind.startsWith("file") && !each.flag);
    const given = Object.fromEntries(records.map(each => [each.name, each.kind === "files" ? (/RECORD/.test(each.shows) ? [name, ...(/FILE/.test(each.shows) && recording_ ? [recording_] : [])] : [recording_]) : /RECORD/.test(each.shows) ? name : recording_]));
    procedure = path;
    say(true);
    fill(definition, given);
    ui.form.scrollIntoView({ block: "start" });
  },
  told: (job, state_) => { if (latestJob?.number === job.number) tell(job, state_); },
};
let latestJob = null;

// The line that stays in sight: what runs, or how the last one ended.
function tell(job, state_ = "") {
  latestJob = job;
  const waiting = [...cards.values()].filter(each => each.open()).length;
  const words = { waiting: "waits", running: "runs", done: state_ ? `done: ${state_}` : "done", refused: "was refused", cancelled: "was cancelled" }[job.state];
  show(ui.status, true);
  ui.status.className = `statusline ${job.state} ${state_}`;
  ui.status.replaceChildren(h("span", {}, `${job.path}${from(job)} ${words}${waiting > 1 ? `; ${waiting} in all` : ""}`), " ",
    h("button", { type: "button", onclick: () => { const found = cards.get(job.number); found.element.open = true; found.element.scrollIntoView({ block: "start" }); } }, job.ended === null ? "Show" : "Show the result"));
}

// Takes results off the list, here and on every page.
function cleared(numbers) {
  for (const number of numbers) {
    cards.get(number)?.element.remove();
    cards.delete(number);
  }
  if (numbers.includes(latestJob?.number)) { latestJob = null; show(ui.status, false); }
  show(ui.clear, cards.size > 0);
}

function worked(job) {
  const known = cards.get(job.number);
  if (known) {
    known.update(job);
  } else {
    const found = card(job, actions);
    for (const each of ui.jobs.children) each.open = false;
    cards.set(job.number, found);
    found.element.files = job.words;
    ui.jobs.prepend(found.element);
    show(ui.clear, true);
  }
  if (cards.get(job.number).failed()) fold(job.path, false); // to be mended there
  if (!latestJob || job.number >= latestJob.number) tell(job);
  if (job.ended !== null && !chosen) {
    const made = job.outputs.find(name => files.some(each => each.name === name && ["recording", "folder"].includes(each.kind)));
    if (made) pick(made);
  }
}
