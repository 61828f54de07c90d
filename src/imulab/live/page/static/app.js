// The page: its socket, its areas and what is said above them.
//
// An area is a module with `title`, `mount(place, page)`, which is called once, `hear(message)`, which gets every
// message of the socket, and `kept()`, which says what stays when the program has ended; `shown()`, where it has one, is
// called whenever it comes into sight. `page.send(message)` answers, `page.say(text, kind)` says something above all areas
// (kind: "note" or "bad"; no text takes it away), and `page.forget()` takes a refusal away once its cause has gone:
// that of a place stands until another is sent, every other one as long as it takes to read it.

import { h, inWords, put, show } from "./dom.js";
import * as session from "./session.js";
import * as workbench from "./workbench.js";

const AREAS = { session, workbench };
const AGAIN = 1000;
const READ = 5000;
const GONE = "The program has ended, or cannot be reached any more.";
const tabs = document.getElementById("tabs");
const mounted = {};
let socket = null;
let ended = false;
let sent = ""; // the type of the latest message
let refused = ""; // that of the message whose refusal stands above the page
let refusedAt = 0;

function say(text, kind = "note") {
  if (ended) return; // it stays why
  refused = "";
  const place = document.getElementById("said");
  if (place.textContent === text) return;
  place.replaceChildren(...(text ? [h("p", { class: `said ${kind}` }, inWords(text))] : []));
}

const page = {
  say,
  send(message) {
    sent = message.type;
    if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
    else say(gone(), "bad");
  },
  forget(type = "") {
    if (!refused || (type !== refused && refused === "place")) return;
    const left = type === refused ? 0 : refusedAt + READ - performance.now();
    const own = refusedAt;
    if (left > 0) setTimeout(() => { if (refused && refusedAt === own) say(""); }, left);
    else say("");
  },
  others: () => Object.keys(mounted),
  // Says that the program ends by itself now, and why: that it is gone is then no news.
  end(text, kind) {
    say(text, kind);
    ended = true;
  },
};

// That it has gone, and what each area keeps.
const gone = () => [GONE, ...Object.keys(mounted).map(name => AREAS[name].kept())].join(" ");

function choose(name) {
  for (const [each, tab] of Object.entries(mounted)) {
    const chosen = each === name;
    show(document.getElementById(each), chosen);
    tab.setAttribute("aria-selected", chosen);
    tab.tabIndex = chosen ? 0 : -1;
  }
  AREAS[name].shown?.();
}

function turn(event) {
  const names = Object.keys(mounted);
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const name = names[(names.findIndex(each => mounted[each] === event.target) + step + names.length) % names.length];
  location.hash = name;
  mounted[name].focus();
}

function begin(names) {
  for (const name of names) {
    if (mounted[name] || !AREAS[name]) continue;
    mounted[name] = h("button", {
      role: "tab", id: `tab-${name}`, "aria-controls": name, onclick: () => { location.hash = name; }, onkeydown: turn,
    }, AREAS[name].title);
    tabs.append(mounted[name]);
    AREAS[name].mount(document.getElementById(name), page);
  }
  const several = Object.keys(mounted).length > 1;
  show(tabs, several);
  for (const [name, tab] of Object.entries(mounted)) {
    const place = document.getElementById(name);
    place.setAttribute("role", several ? "tabpanel" : "region");
    if (several) place.setAttribute("aria-labelledby", tab.id);
    else place.setAttribute("aria-label", AREAS[name].title);
  }
  follow();
}

function follow() {
  const names = Object.keys(mounted);
  if (names.length) choose(names.includes(location.hash.slice(1)) ? location.hash.slice(1) : names[0]);
}

function hear(message) {
  if (message.type === "hello") {
    say("");
    begin(message.areas);
    put(document.getElementById("where"), `version ${message.version}`);
  } else if (message.type === "refused" && sent === "place") {
    session.wrongPlace(inWords(message.text));
  } else if (message.type === "refused") {
    say(message.text, "bad");
    refused = sent || "page";
    refusedAt = performance.now();
  }
  for (const name of Object.keys(mounted)) AREAS[name].hear(message);
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/ws`);
  socket.onmessage = event => hear(JSON.parse(event.data));
  socket.onclose = () => {
    document.documentElement.dataset.connected = "no";
    if (ended) return;
    say(gone(), "bad");
    setTimeout(connect, AGAIN);
  };
  socket.onopen = () => { document.documentElement.dataset.connected = "yes"; };
}

addEventListener("hashchange", follow);
connect();
