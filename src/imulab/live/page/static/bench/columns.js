// How a file is read: the layouts that there are, with a search, and a table of its first rows in which a person says
// what each column is.

import { h, put, show } from "../dom.js";
import { ask, askOnce } from "./net.js";
import { pretty } from "./units.js";

const triad = (sensor, name) => [name, ["x", "y", "z"].map(axis => [`${sensor}_${axis}`, `${sensor} ${axis}`])];
const GROUPS = [
  ["", [["", "leave out"], ["time", "time"], ["temperature", "temperature"]]],
  triad("accel", "accelerometer"), triad("gyro", "gyroscope"), triad("mag", "magnetometer"),
  ["on a centrifuge", [["dtg_x", "tuned gyroscope x"], ["dtg_y", "tuned gyroscope y"], ["fog", "fibre-optic gyroscope"], ["table_angle", "angle of the table"]]],
];
const RATES = ["deg/s", "rad/s", "deg/h", "mdeg/s", "mrad/s", "count", "V"];
const UNITS = {
  time: ["s", "ms", "us", "ns", "iso"], temperature: ["degC", "K"], accel: ["m/s^2", "g", "mg", "count", "V"], gyro: RATES, dtg: RATES, fog: RATES,
  mag: ["uT", "gauss", "nT", "count"], table: ["deg", "rad", "count"],
};
const NAMES = { iso: "date and time", count: "counts", V: "volts", gauss: "gauss" };
const kind = column => column.split("_")[0];
const SOON = 250;

const options = (units, unit) => [...new Set(["", ...units, ...(unit && !units.includes(unit) ? [unit] : [])])]
  .map(each => h("option", { value: each, selected: each === unit }, each ? NAMES[each] || pretty(each) : "unit?"));

// The table of a file's columns. `act.preview(layout)` reads the file so, `act.saved(layout)` when it was saved.
export function columnTable(file, told, act) {
  const said = h("p", { class: "hint", role: "status" });
  const rate = h("input", { type: "text", id: "columns-rate", inputmode: "decimal", placeholder: "100", oninput: soon, autocomplete: "off" });
  const rateField = h("div", { class: "field" }, h("label", { for: "columns-rate" }, "rows in a second, Hz"), rate, h("small", {}, "No column is the time, so the rate says when each row was."));
  const name = h("input", { type: "text", id: "columns-name", value: file.short.replace(/\.[^.]*$/, "").replace(/\d+$/, ""), spellcheck: "false", autocomplete: "off" });
  const save = h("button", { type: "submit", class: "main" }, "Save as layout");
  let later = null;
  let asked = 0;

  const columns = told.columns.map((each, place) => {
    const what = h("select", { "aria-label": `column ${place + 1}, ${each.title}: what it is`, onchange: () => { unit.replaceChildren(...options(UNITS[kind(what.value)] || [], unitOf(each.unit, what.value))); together(what.value); soon(); } },
      GROUPS.map(([title, found]) => {
        const made = found.map(([value, text]) => h("option", { value, selected: value === each.column }, text));
        return title ? h("optgroup", { label: title }, made) : made;
      }));
    const unit = h("select", { "aria-label": `column ${place + 1}, ${each.title}: its unit`, onchange: () => { spread(what.value, unit.value); soon(); } }, options(UNITS[kind(each.column)] || [], each.unit));
    return { place, what, unit, title: each.title };
  });

  const triadUnit = column => columns.find(each => column && each.what.value !== column && kind(each.what.value) === kind(column) && each.unit.value)?.unit.value || "";
  // The unit of a title, where it is one of what the column was said to be; else that of the sensor's other axes.
  const unitOf = (titled, column) => ((UNITS[kind(column)] || []).includes(titled) ? titled : triadUnit(column));
  // The three axes of a sensor have one unit.
  function spread(column, unit) {
    for (const each of columns) if (column.includes("_") && kind(each.what.value) === kind(column)) each.unit.value = unit;
  }
  // Behind an x stand y and z, where nothing is said of them yet.
  function together(column) {
    const first = columns.findIndex(each => each.what.value === column);
    if (!column.endsWith("_x") || first < 0) return;
    ["y", "z"].forEach((axis, step) => {
      const next = columns[first + 1 + step];
      if (!next || next.what.value || columns.some(each => each.what.value === `${kind(column)}_${axis}`)) return;
      next.what.value = `${kind(column)}_${axis}`;
      next.unit.replaceChildren(...options(UNITS[kind(column)] || [], columns[first].unit.value));
    });
  }

  const stated = () => columns.filter(each => each.what.value).map(each => [each.place, each.what.value, each.unit.value]);
  function open() {
    const timed = columns.some(each => each.what.value === "time");
    show(rateField, !timed);
    for (const each of columns) show(each.unit, Boolean(each.what.value));
    const chosen = stated();
    const bare = [...new Set(chosen.filter(([, , unit]) => !unit).map(([, column]) => kind(column)))];
    if (!chosen.some(([, column]) => !["time", "temperature"].includes(column))) return "Say which column is which: accelerometer x, y, z, and so on.";
    if (bare.length) return `Choose the unit of ${bare.map(each => ({ accel: "the accelerometer", gyro: "the gyroscope", mag: "the magnetometer" })[each] || each).join(" and ")}: nothing in the file says it.`;
    if (!timed && !rate.value.trim()) return "Say which column is the time, or how many rows there are in a second.";
    return "";
  }
  function soon() {
    clearTimeout(later);
    later = setTimeout(preview, SOON);
  }
  const statement = more => ["columns", { file: file.name, columns: stated(), sample_rate: rate.value.trim(), ...more }];

  async function preview() {
    const own = asked += 1;
    const missing = open();
    save.disabled = Boolean(missing);
    put(said, missing || "The plots below show the file read so.");
    if (missing) return;
    try {
      const made = await ask(...statement({}));
      if (own === asked) act.preview(made.layout);
    } catch (error) {
      if (own !== asked) return;
      save.disabled = true;
      put(said, error.message);
    }
  }

  const element = h("form", { class: "assistant", onsubmit: async event => {
    event.preventDefault();
    try {
      act.saved((await askOnce(...statement({ name: name.value.trim() || "layout" }))).layout);
    } catch (error) {
      put(said, error.message);
    }
  } },
    h("p", { class: "message" }, "Say what each column is, and its unit. ", told.supposed ? h("small", {}, `Filled in from the file; by its readings: ${told.supposed}.`) : null),
    h("div", { class: "scroll", role: "region", "aria-label": "First rows of the file", tabindex: 0 }, h("table", { class: "columns" },
      h("thead", {},
        h("tr", { class: "choice" }, columns.map(each => h("td", {}, each.what, each.unit))),
        h("tr", {}, columns.map(each => h("th", { scope: "col" }, each.title)))),
      h("tbody", {}, told.rows.map(row => h("tr", {}, columns.map((_, place) => h("td", {}, row[place] ?? ""))))))),
    said, rateField,
    h("div", { class: "saverow" }, h("div", { class: "field" }, h("label", { for: "columns-name" }, "name of the layout"), name), save));
  return { element, begin: preview };
}

// The layouts of the session and those that come with imulab, with a search.
export function layoutList(own, shipped, chosen, use) {
  const all = [...own.map(each => ({ name: each.name, short: each.short, about: "a layout of this session" })), ...shipped.map(each => ({ ...each, short: each.name }))];
  const select = h("select", { id: "layout-list", size: 6, onchange: () => { button.disabled = !select.value; }, ondblclick: () => use(select.value) });
  const button = h("button", { type: "button", disabled: true, onclick: () => use(select.value) }, "Read it with this layout");
  const search = h("input", { type: "search", id: "layout-search", placeholder: "phyphox", autocomplete: "off", oninput: draw });
  function draw() {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = all.filter(each => words.every(word => `${each.short} ${each.about}`.toLowerCase().includes(word)));
    select.replaceChildren(...found.map(each => h("option", { value: each.name, selected: each.name === chosen }, `${each.short}: ${each.about}`)));
    button.disabled = !select.value;
  }
  draw();
  return h("div", { class: "layouts" },
    h("div", { class: "field" }, h("label", { for: "layout-search" }, "search the layouts"), search),
    h("div", { class: "field" }, h("label", { for: "layout-list" }, "layouts"), select), h("p", { class: "go" }, button));
}
