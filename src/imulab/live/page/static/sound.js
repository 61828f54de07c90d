// Tones and spoken advice, for those who look at the unit and not at the page; off until asked for.

import { h } from "./dom.js";

const TONES = {
  accepted: [880, 0.15], knocked: [220, 0.4], enough: [1320, 0.5], warning: [220, 0.4], silent: [220, 0.4], lost: [220, 0.6],
  again: [660, 0.15],
};
let context = null;
let speaks = false;
let spoken = "";

function toggle(name, hint, turned) {
  return h("button", {
    "aria-pressed": "false", title: hint,
    onclick(event) {
      const on = event.target.getAttribute("aria-pressed") !== "true";
      event.target.setAttribute("aria-pressed", on);
      turned(on);
    },
  }, name);
}

export const soundButton = () => toggle("Tones", "A tone for each attitude, and when something is wrong", on => {
  context = on ? new AudioContext() : null;
  if (on) beep("accepted");
});

export const voiceButton = advice => !("speechSynthesis" in window) ? null :
  toggle("Voice", "Reads out what to do", on => {
    speaks = on;
    spoken = "";
    if (on) speak(advice());
    else window.speechSynthesis.cancel();
  });

// Says what to do, once; what was being said gives way to it.
export function speak(text) {
  if (!speaks || text === spoken) return;
  spoken = text;
  window.speechSynthesis.cancel();
  window.speechSynthesis.speak(Object.assign(new SpeechSynthesisUtterance(text), { lang: "en" }));
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
