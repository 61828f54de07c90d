// The list of files: one is shown, and any number of the same kind are chosen with it by their boxes.

import { h, put, redraw, show } from "../dom.js";
import { bytes } from "./net.js";
import { grouped } from "./units.js";

const KINDS = {
  recording: "recording", record: "record", report: "report", layout: "layout", rate: "manifest of a rate test",
  centrifuge: "manifest of a centrifuge test", settings: "settings", folder: "folder", other: "file",
};
const MANY = 8; // files from which a folder opens only when it is looked into

export const kindOf = each => (each.kind === "record" && each.procedure ? `record, ${each.procedure.replace("_", " ")}` : KINDS[each.kind]);
const shape = each => `${each.folder}|${each.kind}|${each.short.replace(/[-+]?\d+/g, "#")}`;

// Files that are alike: of the same kind and folder, with names that differ in numbers.
export const alike = (files, one) => files.filter(each => shape(each) === shape(one));

// `act.choose(name)`, `act.toggle(names, on)`; what is chosen is told by `draw`.
export function fileList(act) {
  const list = h("ul", { class: "list" });
  const place = h("nav", { "aria-label": "Files" }, list);
  const open = new Set();
  let current = null;

  function row(each, chosen, others) {
    const id = `file-${each.name}`;
    const box = ["recording", "record"].includes(each.kind) ? h("input", {
      type: "checkbox", checked: each.name === chosen || others.includes(each.name), disabled: each.name === chosen, "aria-label": `${each.short}, too`, "data-box": each.name,
      onchange: () => act.toggle([each.name], box.checked),
    }) : h("span", { class: "nobox" });
    return h("li", { class: each.folder ? "inner" : null }, box, h("button", {
      type: "button", class: "entry", id, "aria-current": each.name === chosen ? "true" : null, "data-name": each.name, onclick: () => act.choose(each.name),
    }, h("span", { class: "filename" }, each.short), h("span", { class: "kind" }, `${kindOf(each)}${each.kind === "folder" ? "" : `, ${bytes(each.size)}`}`)));
  }

  function folder(each, inner, chosen, others) {
    const opened = open.has(each.name) || inner.length < MANY;
    const more = h("button", { type: "button", class: "fold", "aria-expanded": String(opened), onclick: () => {
      open[opened ? "delete" : "add"](each.name);
      act.redraw();
    } }, opened ? "fold" : `list ${grouped(inner.length)}`);
    const item = row(each, chosen, others);
    if (!inner.length) return [item];
    if (!opened && inner.some(one => one.name === chosen)) item.querySelector(".entry").setAttribute("aria-current", "true");
    put(item.querySelector(".kind"), `folder, ${grouped(inner.length)} ${inner.length === 1 ? "file" : "files"}`);
    if (inner.length >= MANY) item.append(more);
    return [item, ...(opened ? inner.map(one => row(one, chosen, others)) : [])];
  }

  return {
    element: place,
    draw(files, chosen, others) {
      const focused = document.activeElement?.dataset?.name || document.activeElement?.dataset?.box;
      const kind = document.activeElement?.dataset?.box ? "box" : "name";
      const drawn = redraw(list, files.filter(each => !each.folder).flatMap(each => (each.kind === "folder"
        ? folder(each, files.filter(one => one.folder === each.name), chosen, others) : [row(each, chosen, others)])));
      show(place, files.length > 0);
      if (chosen !== current) {  // by a reload or "Look at", it may lie below what the list shows on a small screen
        current = chosen;
        const row = list.querySelector("[aria-current]")?.closest("li");
        const top = row ? row.offsetTop - place.offsetTop : 0;
        if (row) place.scrollTop = Math.min(top, Math.max(place.scrollTop, top + row.offsetHeight - place.clientHeight));
      }
      if (drawn && focused) [...list.querySelectorAll(`[data-${kind}]`)].find(each => each.dataset[kind] === focused)?.focus();
    },
  };
}
