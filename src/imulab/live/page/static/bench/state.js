// What the page shows, in its address: the file, those chosen with it, the procedure and the range; so Back and reload
// lead where one was. What was typed for a file is kept in this tab, beside the address.

const KEY = "imulab-bench";
let kept = {};
try { kept = JSON.parse(sessionStorage.getItem(KEY)) || {}; } catch { /* without storage it is forgotten on reload */ }

export function recall(kind, key) {
  return kept[kind]?.[key];
}

export function keep(kind, key, value) {
  (kept[kind] ||= {})[key] = value;
  try { sessionStorage.setItem(KEY, JSON.stringify(kept)); } catch { /* as above */ }
}

export function inAddress() {
  const query = new URLSearchParams(location.search);
  const number = name => (query.get(name) === null || Number.isNaN(Number(query.get(name))) ? null : Number(query.get(name)));
  return { file: query.get("file"), others: query.getAll("with"), procedure: query.get("do"), range: [number("from"), number("to")] };
}

// A new place is a step that Back undoes; another range of the same is none.
export function toAddress({ file, others = [], procedure, range = [null, null] }, step) {
  const query = new URLSearchParams();
  if (file) query.set("file", file);
  for (const each of others) query.append("with", each);
  if (procedure) query.set("do", procedure);
  if (range[0] !== null) { query.set("from", range[0]); query.set("to", range[1]); }
  const address = `${location.pathname}${query.size ? `?${query}` : ""}${location.hash}`;
  if (address === location.pathname + location.search + location.hash) return;
  history[step ? "pushState" : "replaceState"](null, "", address);
}
