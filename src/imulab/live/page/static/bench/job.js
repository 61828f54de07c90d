// What a command has said and made.

import { h, inWords, put, show } from "../dom.js";
import { commandLine } from "./form.js";
import { address, ask } from "./net.js";
import { lossy, result } from "./result.js";

const STATES = { waiting: "waiting", running: "running", done: "done", refused: "refused", cancelled: "cancelled" };
const FAILED_TEST = /^fail\b/;

const clock = seconds => new Date(seconds * 1000).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
const bare = name => name.slice(Math.max(name.lastIndexOf("/"), name.lastIndexOf("\\")) + 1);

// The files that a command was given, as one says them; of many, the first.
export function from({ inputs }) {
  const names = [...new Set(inputs)].map(bare);
  return !names.length ? "" : ` of ${names.length > 2 ? `${names[0]} and ${names.length - 1} more` : names.join(" and ")}`;
}

// `act.look(name)` shows a file, `act.kind(name)` is its kind; what else `act` has is for `result`.
export function card(job, act) {
  const state = h("span", { class: "chip" });
  const time = h("span", { class: "time" });
  const stale = h("p", { class: "said look", hidden: true });
  const said = h("ul", { class: "heard", "aria-live": "polite" });
  const text = h("pre", { tabindex: 0, "aria-label": "result" });
  const verdict = h("p", { class: "state", hidden: true });
  const made = h("div", { class: "made" });
  const frame = h("div", { class: "report" });
  const first = h("div", {});
  const cancel = h("button", { type: "button", onclick: () => { cancel.disabled = true; ask(`jobs/${job.number}`, undefined, { method: "DELETE" }).catch(() => {}); } }, "Cancel");
  const element = h("details", { class: "job", open: true, id: `job-${job.number}` },
    h("summary", {}, h("strong", {}, job.path), h("span", { class: "from" }, from(job)), state, h("span", { class: "time" }, `${clock(job.began)}, `), time),
    stale, h("p", { class: "go" }, cancel), first, verdict, made, frame,
    h("details", { class: "more all", open: true }, h("summary", {}, "All that it says"), said, text, h("p", { class: "same" }, "The command that does the same:"), commandLine(job.command)));
  const all = element.querySelector(".all");
  let now = null;

  function tick() {
    const seconds = (now.ended ?? Date.now() / 1000) - now.began;
    if (now.state === "waiting") put(time, "until one of those that run has ended: as many run as there are cores");
    else put(time, `${seconds < 10 ? Math.max(seconds, 0).toFixed(1) : Math.round(seconds)} s`);
    if (now.ended === null) setTimeout(tick, 500);
  }

  function report(name) {
    if (frame.firstChild) { frame.replaceChildren(); return; }
    const source = address("reports", name);
    frame.append(
      h("p", {}, h("a", { href: source, target: "_blank", rel: "noopener" }, "the report on a page of its own")),
      h("iframe", { src: source, sandbox: "allow-scripts allow-popups allow-modals", title: `report ${name}`, loading: "eager" }));
  }

  function buttons(name) {
    const short = bare(name);
    const kind = act.kind(name) || (short.endsWith(".html") ? "report" : short.includes(".") ? "recording" : "folder");
    const save = (href, label) => h("a", { class: "button", href, download: "" }, label);
    if (kind === "folder") return [...(act.holds(name) ? [h("button", { type: "button", class: "main", onclick: () => act.look(name) }, `Look at ${short}`)] : []), save(address("zip", name), `Save ${short}.zip`)];
    if (kind === "report") return [h("button", { type: "button", onclick: () => report(name) }, `Show ${short}`), save(address("files", name), `Save ${short}`)];
    return [save(address("files", name), `Save ${short}`), h("button", { type: "button", onclick: () => act.look(name) }, `Look at ${short}`)];
  }

  function update(next) {
    const ended = next.ended !== null && now?.ended == null;
    now = next;
    const failed = FAILED_TEST.test(now.text);
    put(state, failed ? "fail" : STATES[now.state]);
    state.className = `chip ${failed ? "refused" : now.state}`;
    show(cancel.parentElement, now.ended === null);
    show(stale, now.replaced.length > 0);
    put(stale, `Made from an older ${now.replaced.map(bare).join(" and ")}, which has been replaced since.`);
    for (const line of now.messages.slice(said.children.length)) {
      const own = line.replace(/^imulab: /, "");
      said.append(h("li", { class: /^(note|warning)/.test(own) ? own.split(":")[0] : now.status === 0 ? "" : "bad" }, inWords(own)));
    }
    if (!ended) return;
    const [head, ...rest] = now.text.split("\n");
    const found = /^(good|look|bad|pass|fail)\b/.exec(head);
    show(verdict, Boolean(found));
    if (found) {
      put(verdict, head);
      verdict.className = `state ${{ pass: "good", fail: "bad" }[found[1]] || found[1]}`;
    }
    put(text, found ? rest.join("\n").replace(/^\n+/, "") : now.text);
    show(text, Boolean(text.textContent.trim()));
    made.replaceChildren(...now.outputs.flatMap(buttons));
    if (now.state === "refused" && now.words[0] === "export" && now.messages.some(each => /lossy/.test(each))) first.replaceChildren(lossy(now, act));
    if (now.state === "done") see(found);
  }

  // The result of a record comes first; of a report alone, the report.
  async function see(known) {
    const drawn = now.outputs.find(name => name.endsWith(".html"));
    const json = now.outputs.some(name => name.endsWith(".json"));
    const seen = json ? await ask(`results/${now.number}`).catch(() => ({})) : {};
    if (seen.state) {
      first.replaceChildren(result(seen, act));
      show(verdict, false);
      all.open = false;
    } else if (drawn && Date.now() / 1000 - now.ended < 20) {
      report(drawn);
    }
    act.told(now, seen.state || (known ? known[1] : ""));
  }

  show(text, false);
  update(job);
  tick();
  return { element, update, open: () => now.ended === null, failed: () => ["refused", "cancelled"].includes(now.state) };
}
