// A form for a command, made from the command's own definition, with the command line that it makes.

import { h, put, show } from "../dom.js";
import { ask, copy } from "./net.js";

const SOON = 200;

export const plain = flag => flag.replace(/^-+/, "").replaceAll("-", " ");

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

// `run(values)` is called to run it; `files()` are those of the session.
export function form(definition, { files, values = {}, run }) {
  const fields = definition.fields.map(each => field(each, files, values[each.name], changed));
  const refused = h("p", { class: "refused", role: "alert", hidden: true });
  const line = commandLine(`imulab ${definition.path}`);
  const go = h("button", { type: "submit", class: "main" }, "Run");
  const group = (found, title) => found.length
    ? h("details", { class: "more" }, h("summary", {}, title), h("div", { class: "fields" }, found.map(each => each.element))) : null;
  const main = fields.filter(({ of }) => !of.flag || of.required || of.kind === "output");
  const of = (...groups) => fields.filter(each => !main.includes(each) && groups.includes(each.of.group));
  const own = of("model");
  const few = own.length <= 8;
  const element = h("form", { class: "form", novalidate: true, onsubmit: event => {
    event.preventDefault();
    run(read()).catch(say);
  } },
    h("p", { class: "caption" }, definition.help),
    h("div", { class: "fields" }, main.filter(({ of }) => of.kind !== "output").map(each => each.element), of("gravity").map(each => each.element), (few ? own : own.slice(0, 7)).map(each => each.element)),
    few ? null : group(own.slice(7), "More options"),
    group(of("further triads"), "Further triads"),
    group(of("reading", "output", "all commands"), "Reading the file, and what is said"),
    h("div", { class: "fields" }, main.filter(({ of }) => of.kind === "output").map(each => each.element)),
    refused, h("p", { class: "same" }, "The command that does the same:"), line, h("p", { class: "go" }, go));
  let later = null;

  function read() {
    return Object.fromEntries(fields.map(each => [each.of.name, each.read()]).filter(([, value]) => value !== null && value !== ""));
  }
  function say(error) {
    put(refused, error ? error.message : "");
    show(refused, Boolean(error));
  }
  async function preview() {
    try {
      const found = await ask("command", { command: definition.path, values: read() });
      line.put(found.command);
      fields.filter(({ of }) => of.kind === "output").forEach(each => each.suggest(found.outputs));
      say(null);
    } catch (error) {
      say(error);
    }
  }
  function changed() {
    clearTimeout(later);
    later = setTimeout(preview, SOON);
  }
  changed();
  return { element, read, refresh() { fields.forEach(each => each.refresh?.()); changed(); } };
}

let count = 0;

function field(of, files, value, changed) {
  const id = `field-${count += 1}`;
  const help = of.help ? h("small", { id: `${id}-help` }, of.help) : null;
  const common = { id, "aria-describedby": help ? `${id}-help` : null, onchange: changed, oninput: changed };
  const label = text => h("label", { for: id }, text);
  const title = of.flag ? plain(of.flag) : of.shows.replace("... ", "s, then ").replaceAll("...", "s").replaceAll("|", " or ").toLowerCase();
  const built = (control, read, more = {}) => ({
    of, read, element: h("div", { class: `field ${of.kind}` }, label(more.title || title), control, help), ...more,
  });
  const options = (chosen, empty) => [
    empty === null ? null : h("option", { value: "" }, empty),
    ...files().map(each => h("option", { value: each.name, selected: each.name === chosen }, each.short)),
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
        h("span", {}, box, h("label", { for: `${id}-write` }, of.help ? of.help.replace(/\.$/, "") : "write")),
        (name.setAttribute("aria-label", "its name"), name)),
    };
  }
  if (of.kind === "files") return several(of, id, title, options, value, changed, help);
  if (of.kind === "texts") return texts(of, common, title, value, changed, help);
  if (of.kind === "file" && !of.other) {
    const select = h("select", common, options(value, of.required ? "choose a file" : "none"));
    return built(select, () => select.value, { refresh() { select.replaceChildren(...options(select.value, of.required ? "choose a file" : "none").filter(Boolean)); } });
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
    placeholder: of.default || (/^(VALUE|NUMBER|QUANTITY)$/.test(of.shows) ? "" : of.shows),
  });
  return built(h("span", { class: "input" }, input, list), () => input.value.trim());
}

// Texts, each of which becomes an option of its own; an empty one follows the last.
function texts(of, common, title, value, changed, help) {
  const rows = h("span", { class: "several" });
  const add = text => rows.append(h("input", {
    ...common, id: rows.children.length ? null : common.id, "aria-label": rows.children.length ? `another of ${title}` : null,
    type: "text", spellcheck: "false", autocomplete: "off", value: text, placeholder: of.shows, oninput: () => { fill(); changed(); },
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
  return {
    of,
    read: () => [...rows.children].map(each => each.value).filter(Boolean),
    refresh() { for (const each of rows.children) each.replaceChildren(...options(each.value, "none").filter(Boolean)); },
    element: h("div", { class: "field files" }, h("label", { for: id }, title), rows, help),
  };
}
