// Which procedures a file is for, by what is in it; of the others, why not.

const has = (facts, sensor) => ["x", "y", "z"].every(axis => facts.columns.includes(`${sensor}_${axis}`));
const some = (facts, pattern) => facts.columns.some(name => pattern.test(name));
const ELEMENTS = /^(gyro|accel)(_[xyz])?_\d+$/;
const SENSORS = { accel: "accelerometers", gyro: "gyroscopes", mag: "magnetometers" };

const holds = (...sensors) => facts => sensors.filter(each => !has(facts, each)).map(each => `there are no three ${SENSORS[each]} in it`)[0];
const timed = facts => (facts.timed ? "" : "its times do not rise");
const rates = facts => (some(facts, /^(gyro|fog|dtg)/) ? "" : "there is no gyroscope in it");
const inertial = facts => (some(facts, /^(accel|gyro|fog|dtg)/) ? "" : "there is no accelerometer and no gyroscope in it");
const several = facts => (facts.count > 1 ? "" : "it takes several files: choose them in the list");
const array = facts => (some(facts, ELEMENTS) ? "" : "there are no several gyroscopes in it (gyro_1, gyro_2 ..)");
const imus = facts => (some(facts, /^accel_[xyz]_\d+$/) ? "" : "there are no several IMUs in it (accel_x_1, accel_x_2 ..)");
const warm = facts => (some(facts, /^temperature/) ? "" : "there is no temperature in it");
const record = (...procedures) => facts => (facts.records.some(each => !procedures.length || procedures.includes(each)) ? ""
  : `it needs a record${procedures.length ? ` of ${procedures.join(" or ")}` : ""}, and there is none here yet`);

// Of each command the conditions, the first that fails is the reason.
const NEEDS = {
  "tumble fit": [holds("accel"), facts => (facts.timed && facts.attitudes === 0 ? "no attitude at rest was found in it" : "")],
  "tumble gyro": [holds("gyro"), timed],
  "tumble mag": [holds("mag")],
  "magnetometer fit": [holds("mag")],
  "magnetometer check": [holds("mag"), record("magnetometer")],
  "tumble check": [holds("accel"), record("tumble", "thermal")],
  "thermal fit": [warm, inertial],
  "thermal check": [warm, inertial, record("thermal")],
  "warmup fit": [rates, timed, several],
  "noise fit": [inertial, timed],
  "noise check": [inertial, timed, record("noise")],
  allan: [inertial, timed],
  "rate fit": [rates, timed],
  "rate turn": [holds("gyro"), timed],
  "array calibrate": [array, timed], "array fuse": [array, timed], "array compare": [array, timed],
  "array calibrate --imus": [imus, timed],
  "array fuse --imus": [imus, timed, record("gyro_array")],
  "array compare --imus": [imus, timed, record("gyro_array")],
  "array merge": [rates, several],
  apply: [record()],
};
const RECORDS = { report: [], certificate: [], export: [], "warmup table": ["warmup"], "tumble check": ["tumble", "thermal"], "thermal check": ["thermal"], "noise check": ["noise"], "magnetometer check": ["magnetometer"], apply: [], show: [] };
const ONE = new Set(["tumble fit", "tumble gyro", "tumble mag", "magnetometer fit", "magnetometer check", "tumble check", "rate fit", "rate turn", "array calibrate", "array fuse", "array compare", "array calibrate --imus", "array fuse --imus", "array compare --imus", "allan", "convert", "apply", "show"]);
const LATER = ["show", "convert", "layout guess"]; // what the page does by itself, or what is rarely wanted

// The sentence that says why a procedure is not for what is chosen; none where it is. Nothing is known of a recording
// before its first rows are read: then all are offered.
export function reason(path, facts) {
  if (facts.kind === "rate" || facts.kind === "centrifuge") {
    const own = facts.kind === "rate" ? "rate fit" : "centrifuge reduce";
    return path === own ? "" : `this is the manifest of a ${facts.kind} test: ${own} takes it`;
  }
  if (facts.kind === "record") {
    const of = RECORDS[path];
    if (!of) return "it takes recordings, this is a record";
    return !of.length || of.includes(facts.procedure) ? "" : `it takes a record of ${of.join(" or ")}`;
  }
  if (facts.kind !== "recording") return "it takes recordings or records";
  if (path === "centrifuge reduce") return "it takes a manifest, which names the runs";
  if (path in RECORDS && !(path in NEEDS) && path !== "show") return "it takes a record";
  if (!facts.known) return "";
  return (NEEDS[path] || []).map(need => need(facts)).find(Boolean) || (facts.count > 1 && ONE.has(path) ? `it takes one file, ${facts.count} are chosen` : "");
}

// The likeliest first: of warm-up cycles the table, of a rate manifest the rate fit.
export function likely(one, other, facts) {
  const rank = path => {
    if (LATER.includes(path)) return 90;
    if (path === "warmup fit" && facts.count > 1) return 0;
    if (path === "magnetometer fit" && has(facts, "mag") && !has(facts, "accel")) return 0;
    if (path === "noise fit" && facts.turned === false && !has(facts, "accel")) return 5;
    if (path.startsWith("array") && some(facts, ELEMENTS)) {
      const board = !imus(facts) && path.endsWith("--imus");
      return (path.includes("calibrate") ? 2 : 5) - (board ? 1 : 0);
    }
    const order = ["tumble fit", "rate fit", "centrifuge reduce", "thermal fit", "noise fit", "tumble mag", "rate turn", "tumble gyro", "allan", "tumble check", "apply", "thermal check", "noise check"];
    return order.includes(path) ? 10 + order.indexOf(path) : 50;
  };
  return rank(one) - rank(other);
}
