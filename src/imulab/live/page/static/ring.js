// The ring beside the sentence: how far a hold is, seen from where the unit lies.

import { put, s } from "./dom.js";

const R = 42, ROUND = 2 * Math.PI * R;
const SIGNS = { accepted: "✓", done: "✓", silent: "!", lost: "!", failed: "!", computing: "…", settling: "…", absent: "…", unknown: "?" };

export class Ring {
  constructor() {
    this.full = s("circle", { class: "full", r: R, transform: "rotate(-90)" });
    this.text = s("text", { y: 8 });
    this.place = s("svg", { class: "ring", viewBox: "-50 -50 100 100", "aria-hidden": "true" },
      s("circle", { class: "round", r: R }), this.full, this.text);
  }

  // Draws a state: a hold by its length against the length that it needs; away is how far the unit is to be turned, degrees.
  draw(state, hold, needed, away) {
    const part = { still: needed ? Math.min(hold / needed, 1) : 0, accepted: 1, done: 1 }[state] || 0;
    this.full.setAttribute("stroke-dasharray", `${part * ROUND} ${ROUND}`);
    put(this.text, state === "still" ? `${hold.toFixed(1)} s` : SIGNS[state] || (away === null ? "" : `${away}°`));
  }
}
