// The workbench: recordings are dropped here, seen, calibrated, and left as records.

import { h } from "./dom.js";

export const title = "Workbench";

export function mount(place) {
  place.append(h("section", {}, h("h2", {}, "Workbench")));
}

export function hear() {}
