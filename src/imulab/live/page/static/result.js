// The record, once it is made: what it says, its files, and the reading corrected by it.

import { h, inWords, put } from "./dom.js";
import { parameterTable } from "./tables.js";

const HEADS = { good: "Good.", look: "Look first.", bad: "Stop." };
const FILES = { record: "Save the record", report: "Open the report", recording: "Save the recording" };

export class ResultArea {
  constructor(page) {
    this.page = page;
    this.place = h("div", {});
  }

  done(message) {
    this.length = h("dd", {}, "–");
    this.beside = h("p", { class: "caption live" });
    const files = message.files.map(file => h("a", {
      class: "button", href: file.href, ...(file.kind === "report" ? { target: "_blank", rel: "noopener" } : { download: file.name }),
    }, FILES[file.kind]));
    if (this.page.others().includes("workbench")) files.push(h("a", { class: "button", href: "#workbench" }, "Firmware and other formats"));
    this.place.replaceChildren(h("section", { class: "result" },
      h("h2", {}, "The record"),
      h("div", { class: `said ${message.verdict}` }, h("strong", {}, `${HEADS[message.verdict]} `), message.headline,
        message.reasons.length ? h("ul", {}, message.reasons.map(text => h("li", {}, inWords(text)))) : null,
        message.next.map(text => h("p", {}, h("b", {}, "next: "), inWords(text)))),
      h("p", { class: "files" }, files, h("button", { onclick: () => this.quit() }, "End the session")),
      h("dl", { class: "facts" }, h("div", {}, h("dt", {}, "|f| now, corrected by the record"), this.length)),
      this.beside,
      h("p", { class: "caption" }, "The same record, from the recording:"),
      h("pre", { tabindex: 0, role: "region", "aria-label": "Command" }, message.command),
      parameterTable({ parameters: message.parameters })));
  }

  corrected(message) {
    if (!this.length) return;
    put(this.length, `${message.length.toFixed(4)} m/s²`);
    const turning = message.rate === null ? "" : `, ${(message.rate * 180 / Math.PI).toFixed(3)} deg/s corrected`;
    const raw = message.raw === null ? "" : `${message.raw.toFixed(4)} m/s² uncorrected${turning}; `;
    put(this.beside, `${raw}at rest ${message.gravity.toFixed(4)} m/s² is right. Turn the unit, and see.`);
  }

  quit() {
    this.page.send({ type: "quit" });
    this.page.end("The session has ended; this page can be closed.", "note");
  }
}
