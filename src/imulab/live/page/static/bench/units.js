// Units as people write them, and numbers that fit beside them.

const WORDS = { degC: "°C", uT: "µT", "deg/s": "°/s", "deg/h": "°/h", ug: "µg", us: "µs", deg: "°", 1: "" };

export function pretty(unit) {
  if (unit in WORDS) return WORDS[unit];
  return unit.replace(/\^2/g, "²").replace(/\^3/g, "³").replace(/\bdeg\b/g, "°").replace(/\bu(?=[gTsm]\b)/g, "µ").replace(/sqrt\((\w+)\)/g, "√$1");
}

// A number with so many significant digits; large powers of ten as such.
export function written(value, digits = 5) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  const size = Math.abs(value);
  if (value && (size >= 1e7 || size < 1e-5)) return value.toExponential(digits - 2).replace("-", "−").replace("e+", "e");
  const places = value ? Math.max(0, digits - 1 - Math.floor(Math.log10(size))) : 0;
  return value.toFixed(Math.min(places, 9)).replace("-", "−");
}

export const grouped = count => count.toLocaleString("en").replaceAll(",", " ");
