// A form for a command, made from the command's own definition, with the command line that it makes.

import { h, inWords, put, redraw, show } from "../dom.js";
import { ask, copy } from "./net.js";

const SOON = 200;
const FRONT = 3; // options of a model that stand in front
const MANY = 4; // files from which a field tells their number first

export const plain = flag => flag.replace(/^-+/, "").replaceAll("-", " ");

// Examples, for values whose kind alone says little; they are no defaults.
const EXAMPLES = {
  gravity: "9.8136", latitude: "48.14", height: "520", window: "10:60", units: "gyro=deg/s", serial: "SN42", topic: "/imu/data", instance: "0", element: "1",
  unpack_limit: "2 GB", damaged: "skip", monte_carlo: "1000", noise: "20 ug", temperatures: "-20,0,25,45,60", rates: "0,100,-100,0", limit: "2 mg", axes: "x,y", columns: "gyro_x",
  horizon: "1 h", band: "10 Hz", settling_time: "60 s", turns: "2,2,2", table_uncertainty: "50 ppm", sample_rate: "100", turn_on_scatter: "0.1 mg", settle: "5 min", gyro_turn_on_scatter: "0.01 deg/s",
  white: "0.005 deg/sqrt(s)", flicker: "2 deg/h", walk: "0.01 deg/h/sqrt(h)", quantisation: "0.5 arcsec", gm: "3 deg/h:100 s", hemisphere: "north", rate: "100 Hz", duration: "1 h",
  threshold: "5ppm,2ug,3arcsec", nonlinearity: "20ug,20ug", asymmetry: "20 ppm", ageing: "100ug,100ppm", field: "48.2", dip: "67.2", with_: "gyro,mag", tilt: "0.2 mrad",
};

// The command that does the same, to copy.
export function commandLine(text) {
  const code = h("code", {}, text);
  const button = h("button", { type: "button", class: "copy", onclick: async () => {
    const done = await copy(code.textContent);
    put(button, done ? "copied" : "select it to copy");
    if (!done) getSelection().selectAllChildren(code);
    setTimeout(() => put(button, "copy"), 2000);
  } }, "copy");
  const place = h("div", { class: "command", role: "group", "aria-label": "The command that does the same" }, code, button);
  place.put = said => put(code, said);
  return place;
}

// `run(values)` is called to run it, `keep(values)` with what was typed; `files()` are those of the session.
export function form(definition, { files, values = {}, run, keep = () => {} }) {
  const fields = definition.fields.map(each => field(each, files, values[each.name], changed));
  const refused = h("p", { class: "refused", role: "alert", hidden: true });
  const line = commandLine(`imulab ${definition.path}`);
  const go = h("button", { type: "submit", class: "main" }, "Run");
  const group = (found, title) => found.length
    ? h("details", { class: "more" }, h("summary", {}, title), h("div", { class: "fields" }, found.map(each => each.element))) : null;
  const main = fields.filter(({ of }) => !of.flag || of.required || of.kind === "output");
  const of = (...groups) => fields.filter(each => !main.includes(each) && groups.includes(each.of.group));
  const own = of("model");
  const front = own.filter((each, number) => number < FRONT || values[each.of.name]);
  const behind = own.filter(each => !front.includes(each));
  const part = h("p", { class: "part", hidden: true });
  const element = h("form", { class: "form", novalidate: true, "data-asked": "", onsubmit: async event => {
    event.preventDefault();
    const values = read(); // what stands there at the click, whatever comes before the answer
    const text = JSON.stringify(values);
    if (text === started) return; // it was clicked on already, and the answer is not here yet
    started = text;
    if (await preview(values)) await run(values).catch(say);
    if (text === started) started = "";
  } },
    h("p", { class: "caption" }, inWords(definition.help)),
    h("div", { class: "fields" }, main.filter(({ of }) => of.kind !== "output").map(each => each.element)),
    h("div", { class: "fields" }, of("gravity").map(each => each.element)),
    h("div", { class: "fields" }, front.map(each => each.element)),
    group(behind, "More options"),
    group(of("further triads"), "Further triads"),
    group(of("reading", "output", "all commands"), "Reading the file, and what is said"),
    part,
    h("div", { class: "fields" }, main.filter(({ of }) => of.kind === "output").map(each => each.element)),
    refused, h("p", { class: "go" }, go), h("p", { class: "same" }, "The command that does the same:"), line);
  let later = null;
  let started = "";
  let version = 0; // of what is typed: an answer to an older one is late

  function read() {
    return Object.fromEntries(fields.map(each => [each.of.name, each.read()]).filter(([, value]) => value !== null && value !== ""));
  }
  function say(error) {
    put(refused, error ? error.message : "");
    show(refused, Boolean(error));
  }
  // Whether all values can be; what cannot is said at its field.
  async function preview(values = read()) {
    clearTimeout(later);
    const own = version;
    const window_ = values.window;
    show(part, Boolean(window_));
    if (window_) part.replaceChildren(`Only ${window_.replace(":", " to ")} s of the file. `, h("button", { type: "button", onclick: () => set("window", "") }, "Take the whole file"));
    try {
      const found = await ask("command", { command: definition.path, values });
      const first = fields.find(each => found.wrong[each.of.name]);
      if (own !== version) return !first;
      line.put(found.command);
      fields.filter(({ of }) => of.kind === "output").forEach(each => each.suggest(found.outputs));
      fields.forEach(each => wrong(each, found.wrong[each.of.name]));
      delete element.dataset.asked;
      say(null);
      if (first && document.activeElement === go) { const shut = first.element.closest("details"); if (shut) shut.open = true; first.element.querySelector("input, select").focus(); }
      return !first;
    } catch (error) {
      if (own === version) say(error);
      return true; // it is refused where it is run, with the same sentence
    }
  }
  function changed() {
    clearTimeout(later);
    version += 1;
    element.dataset.asked = "";
    keep(typed());
    later = setTimeout(preview, SOON);
  }
  const typed = () => Object.fromEntries(fields.filter(({ of }) => !of.kind.startsWith("file") && of.kind !== "output").map(each => [each.of.name, each.read()]).filter(([, value]) => value !== null && value !== "" && value.length !== 0));
  function set(name, value) {
    const input = fields.find(each => each.of.name === name)?.element.querySelector("input");
    if (!input) return false;
    input.value = value;
    changed();
    return true;
  }
  preview();
  return { element, read, set, go, refresh() { fields.forEach(each => each.refresh?.()); changed(); } };
}

// Says at a field why its value cannot be, or takes that away.
function wrong(each, text) {
  let place = each.element.querySelector(".wrong");
  if (!place && !text) return;
  if (!place) each.element.append(place = h("span", { class: "wrong", role: "alert", id: `wrong-${count += 1}` }));
  const input = each.element.querySelector("input, select");
  input.setAttribute("aria-invalid", String(Boolean(text)));
  input.setAttribute("aria-errormessage", place.id);
  put(place, text ? inWords(text) : "");
  show(place, Boolean(text));
}

let count = 0;

function field(of, files, value, changed) {
  const id = `field-${count += 1}`;
  const help = of.help ? h("small", { id: `${id}-help` }, inWords(of.help)) : null;
  const common = { id, "aria-describedby": help ? `${id}-help` : null, onchange: changed, oninput: changed };
  const label = text => h("label", { for: id }, text);
  const title = of.flag ? plain(of.flag) : of.shows.replace(/\b[A-Z]+\.toml\b/, "manifest").replace("... ", "s, then ").replaceAll("...", "s").replaceAll("|", " or ").toLowerCase();
  const built = (control, read, more = {}) => ({
    of, read, element: h("div", { class: `field ${of.kind}` }, label(more.title || title), control, help), ...more,
  });
  const options = (chosen, empty) => [
    h("option", { value: "" }, empty),
    ...files().filter(each => !["folder", "report"].includes(each.kind)).map(each => h("option", { value: each.name, selected: each.name === chosen }, each.folder ? `${each.folder.slice(each.folder.lastIndexOf("/") + 1)}/${each.short}` : each.short)),
  ];

  if (of.kind === "switch") {
    const box = h("input", { ...common, type: "checkbox", checked: value === true });
    return { of, read: () => box.checked || null, element: h("div", { class: "field switch" }, box, label(title), help) };
  }
  if (of.kind === "either") {
    const select = h("select", common, ["", "yes", "no"].map(each => h("option", { value: each }, each || "as it follows")));
    return built(select, () => ({ yes: true, no: false })[select.value] ?? null);
  }
  if (of.kind === "output") {
    const box = h("input", { type: "checkbox", id: `${id}-write`, checked: value !== false, disabled: of.required, onchange: () => { name.disabled = !box.checked; changed(); } });
    const name = h("input", { ...common, type: "text", spellcheck: "false", autocomplete: "off" });
    return {
      of,
      read: () => (box.checked ? name.value.trim() || true : null),
      suggest(paths) {
        const found = paths.find(path => path.endsWith(of.ending) || !of.ending);
        if (found) name.placeholder = found.slice(found.lastIndexOf("/") + 1);
      },
      element: h("div", { class: "field output" },
        h("span", {}, box, h("label", { for: `${id}-write` }, of.help ? inWords(of.help).replace(/\.$/, "") : "write")),
        (name.setAttribute("aria-label", "its name"), name)),
    };
  }
  if (of.kind === "files") return several(of, id, title, options, value, changed, help);
  if (of.kind === "texts") return texts(of, common, title, value, changed, help);
  if (of.kind === "file" && !of.other) {
    const select = h("select", common, options(value, of.required ? "choose a file" : "none"));
    return built(select, () => select.value, { refresh() { redraw(select, options(select.value, of.required ? "choose a file" : "none")); } });
  }
  if (of.choices.length && !of.other) {
    const select = h("select", common, of.choices.map(each => h("option", { value: each, selected: each === (value || of.default) }, each)),
      of.default || of.choices.includes("") ? null : h("option", { value: "", selected: !value }, "as it follows"));
    return built(select, () => (select.value === of.default ? null : select.value));
  }
  const words = [...of.choices, ...(of.kind === "file" ? files().map(each => each.name) : [])];
  const list = words.length ? h("datalist", { id: `${id}-words` }, words.map(each => h("option", { value: each }))) : null;
  const input = h("input", {
    ...common, type: "text", spellcheck: "false", autocomplete: "off", list: list ? `${id}-words` : null, value: value || null,
    placeholder: of.default || (EXAMPLES[of.name] ? `e.g. ${EXAMPLES[of.name]}` : /^[A-Z_,.:|\[\]]*$/.test(of.shows) ? "" : `e.g. ${of.shows}`),
  });
  return built(h("span", { class: "input" }, input, list), () => input.value.trim());
}

// Texts, each of which becomes an option of its own; an empty one follows the last.
function texts(of, common, title, value, changed, help) {
  const rows = h("span", { class: "several" });
  const add = text => rows.append(h("input", {
    ...common, id: rows.children.length ? null : common.id, "aria-label": rows.children.length ? `another of ${title}` : null,
    type: "text", spellcheck: "false", autocomplete: "off", value: text, placeholder: EXAMPLES[of.name] ? `e.g. ${EXAMPLES[of.name]}` : "", oninput: () => { fill(); changed(); },
  }));
  const fill = () => { if (!rows.lastChild || rows.lastChild.value) add(null); };
  for (const each of value || []) add(each);
  fill();
  return {
    of,
    read: () => [...rows.children].map(each => each.value.trim()).filter(Boolean),
    element: h("div", { class: "field texts" }, h("label", { for: common.id }, title), rows, help),
  };
}

// Files in the order in which the command gets them.
function several(of, id, title, options, value, changed, help) {
  const rows = h("span", { class: "several" });
  const add = (chosen, first) => {
    const select = h("select", { id: first ? id : null, "aria-label": first ? null : `another of ${title}`, onchange: () => { fill(); changed(); } }, options(chosen, first ? "choose a file" : "none"));
    rows.append(select);
  };
  const fill = () => {
    const selects = [...rows.children];
    if (!selects.length || selects[selects.length - 1].value) add(null, !selects.length);
  };
  for (const each of value || []) add(each, !rows.children.length);
  fill();
  const given = value || [];
  const short = name => name.slice(name.lastIndexOf("/") + 1);
  const list = given.length > MANY ? h("details", { class: "many" }, h("summary", {}, `${given.length} files: ${short(given[0])} to ${short(given[given.length - 1])}`), rows) : rows;
  return {
    of,
    read: () => [...rows.children].map(each => each.value).filter(Boolean),
    refresh() { for (const each of rows.children) redraw(each, options(each.value, each === rows.firstChild ? "choose a file" : "none")); },
    element: h("div", { class: "field files" }, h("label", { for: id }, title), list, help),
  };
}
