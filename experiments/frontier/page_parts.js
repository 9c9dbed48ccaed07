// What the page is made of: elements, marks, numbers as text, and the scale of an axis.
"use strict";

function element(name, attributes = {}, ...content) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...content);
  return node;
}

function svg(name, attributes = {}, text = "") {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.textContent = text;
  return node;
}

function corners(angles, lengths) {
  const steps = angles.map((angle, k) => {
    const [x, y] = [Math.sin(angle), -Math.cos(angle)].map((v) => v * lengths[k % lengths.length]);
    return `${x.toFixed(2)} ${y.toFixed(2)}`;
  });
  return `M${steps.join("L")}Z`;
}

const polygon = (count, turn, ...lengths) => (r) =>
  corners(Array.from({ length: count }, (_, k) => ((k + turn) / count) * 2 * Math.PI),
    lengths.map((length) => length * r));
const plus = (turn) => (r) => {
  const near = Math.atan2(1, 3), far = Math.hypot(1, 3) * 0.38 * r;
  const angles = [0, 1, 2, 3].flatMap((k) => [-near, near, Math.PI / 4].map(
    (angle) => angle + ((k + turn) * Math.PI) / 2));
  return corners(angles, [far, far, Math.SQRT2 * 0.38 * r]);
};
const MARKS = [ // of like weight, in the order of chart.py
  (r) => `M${-r} 0A${r} ${r} 0 1 1 ${r} 0A${r} ${r} 0 1 1 ${-r} 0Z`,
  polygon(4, 0.5, 1.25), polygon(4, 0, 1.3), polygon(3, 0, 1.4), polygon(3, 0.5, 1.4),
  plus(0), polygon(10, 0, 1.45, 0.65), plus(0.5), polygon(3, 0.25, 1.4), polygon(3, 0.75, 1.4),
  polygon(5, 0, 1.2), polygon(6, 0, 1.15),
];
const radius = (mapSize) => (mapSize ? 1 + 1.3 * Math.log2(mapSize / 64) : 4);

function mark(family, r) {
  const node = svg("path", { d: MARKS[family.mark % MARKS.length](r), fill: family.color });
  if (family.hollow) Object.assign(node.style, { fill: "#fff", stroke: family.color });
  return node;
}

// Numbers

const RAISED = "⁻⁰¹²³⁴⁵⁶⁷⁸⁹";
const raised = (power) => String(power).replace(/./g, (c) => RAISED["-0123456789".indexOf(c)]);

function figure(value) {
  if (value === 0) return "0";
  const [digits, power] = value.toExponential(2).split("e").map(Number);
  if (power < -3) return `${digits.toFixed(2)}×10${raised(power)}`;
  return value < 999.5 ? value.toPrecision(3) : String(Math.round(value));
}

function bytes(value) {
  const power = value < 1 ? 0 : Math.min(3, Math.floor(Math.log2(value) / 10));
  return `${+(value / 1024 ** power).toPrecision(3)} ${["B", "KiB", "MiB", "GiB"][power]}`;
}

function round(value) {
  const [digits, power] = value.toExponential(1).split("e").map(Number);
  if (value === 0 || (power > -4 && power < 5)) return String(+value.toPrecision(2));
  return `${digits === 1 ? "" : `${digits}×`}10${raised(power)}`;
}

// Axes

const STRIP = 30; // px, of zeros, which a log axis has no place for

/** Places on a log axis in px, with its ticks; zeros lie in a strip at its low end. */
function scale(values, from, to, inBytes) {
  const positive = values.filter((v) => v > 0);
  const zeros = positive.length < values.length;
  let low = Math.min(...positive), high = Math.max(...positive);
  if (!positive.length) low = high = 1;
  const room = Math.max(1.15, (high / low) ** 0.06);
  [low, high] = [low / room, high * room];
  const start = from + (zeros ? STRIP * Math.sign(to - from) : 0);
  const perUnit = (to - start) / Math.log(high / low);
  const place = (v) => (v > 0 ? start + perUnit * Math.log(v / low) : (from + start) / 2);
  const base = inBytes ? 2 : 10;
  const logOf = (v) => Math.log(v) / Math.log(base);
  const span = logOf(high / low);
  const every = Math.ceil((70 * span) / Math.abs(to - start)); // at least 70 px apart
  const steps = base === 2 || span > 3 ? [1] : span > 1.5 ? [1, 2, 5] :
    span > 0.7 ? [1, 1.5, 2, 3, 5, 7] : [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8];
  const ticks = zeros ? [0] : [], minor = [];
  for (let power = Math.floor(logOf(low)); power <= logOf(high); power++) {
    const within = (some) =>
      some.map((v) => v * base ** power).filter((v) => v >= low && v <= high);
    if (power % every === 0) ticks.push(...within(steps));
    if (base === 10) minor.push(...within([1, 2, 3, 4, 5, 6, 7, 8, 9]));
  }
  return { place, ticks, minor, zeros, start, write: inBytes ? bytes : round };
}

