// A tone when an attitude is accepted, for those who look at the unit and not at the page; off until asked for.

import { h } from "./dom.js";

const TONES = { accepted: [880, 0.15], knocked: [220, 0.4], enough: [1320, 0.5], warning: [220, 0.4], silent: [220, 0.4] };
let context = null;

export function soundButton() {
  return h("button", {
    "aria-pressed": "false",
    onclick(event) {
      const on = event.target.getAttribute("aria-pressed") !== "true";
      event.target.setAttribute("aria-pressed", on);
      context = on ? new AudioContext() : null;
      if (on) beep("accepted");
    },
  }, "Sound");
}

export function beep(kind) {
  if (!context || !TONES[kind]) return;
  const [pitch, seconds] = TONES[kind], tone = context.createOscillator(), volume = context.createGain();
  tone.frequency.value = pitch;
  volume.gain.setValueAtTime(0.15, context.currentTime);
  volume.gain.exponentialRampToValueAtTime(0.001, context.currentTime + seconds);
  tone.connect(volume).connect(context.destination);
  tone.start();
  tone.stop(context.currentTime + seconds);
}
