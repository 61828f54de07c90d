// What the workbench asks the server for.

import { unpressed } from "../dom.js";

const HERE = "/api/workbench/";

// A name of a file in an address; what it says stays a part of that address.
export const address = (kind, name) => HERE + kind + "/" + encodeURIComponent(name);

// The answer to a request; what was refused is an error with the server's sentence.
export async function ask(what, body, options = {}) {
  const given = body === undefined ? {} : { method: "POST", body: JSON.stringify(body) };
  let answer;
  try {
    answer = await fetch(HERE + what, { ...given, ...options });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Error("The program cannot be reached any more.");
  }
  const text = await answer.text();
  await unpressed();
  if (answer.ok) return JSON.parse(text);
  let said = text;
  try { said = JSON.parse(text).error; } catch { /* a sentence of its own */ }
  throw new Error(said);
}

// As `ask`, of what starts something: what is asked again before it is answered is not done twice.
const underway = new Map();
export function askOnce(...question) {
  const key = JSON.stringify(question);
  if (!underway.has(key)) underway.set(key, ask(...question).finally(() => underway.delete(key)));
  return underway.get(key);
}

// Sends a file, and tells how much of it has gone, from 0 to 1.
export function send(file, tell) {
  return new Promise((done, failed) => {
    const request = new XMLHttpRequest();
    request.open("PUT", address("files", file.name));
    request.upload.onprogress = event => tell(event.lengthComputable ? event.loaded / event.total : 0);
    request.onerror = () => failed(new Error(`${file.name}: was not received; is it larger than 4 GiB?`));
    request.onload = async () => {
      let answer = {};
      try { answer = JSON.parse(request.responseText); } catch { answer = { error: request.responseText }; }
      await unpressed();
      if (request.status === 200) done(answer);
      else failed(new Error(answer.error || `${file.name}: was not received`));
    };
    request.send(file);
  });
}

export async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return false;
  }
}

export function bytes(size) {
  const units = ["B", "kB", "MB", "GB"];
  let step = 0;
  while (size >= 1000 && step < 3) { size /= 1000; step += 1; }
  return `${step && size < 10 ? size.toFixed(1) : Math.round(size)} ${units[step]}`;
}
