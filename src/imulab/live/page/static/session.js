// The guided session.

import { h, put } from "./dom.js";

export const title = "Session";
let advice = null;

export function mount(place) {
  advice = h("p", { class: "advice", "aria-live": "assertive" });
  place.append(advice);
}

export function hear(message) {
  if (message.type === "view") put(advice, message.advice);
}
