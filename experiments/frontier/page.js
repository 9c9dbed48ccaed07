// Draws a panel (the shadows of a scene, or its shading): an error against a cost, from the JSON
// in #data. Whatever comes from the data is set as text, never as markup.
const get = (id) => document.getElementById(id);
const { rows, errors, costs, families, pictures, made } = JSON.parse(get("data").textContent);
const state = { panel: "", error: "", cost: "", off: new Set(), row: null };
const MARGIN = { top: 12, right: 16, bottom: 48, left: 76 };
const LEGEND = 100; // px that it takes below the chart
const TIMES = [["total_ms", "time of an image"], ["draw_ms_median", "– light pass"],
  ["prepare_ms_median", "– preparation"], ["image_ms_median", "– the image alone"],
  ["gradient_ms_median", "time of a gradient"]];
let points = []; // what is drawn: {row, x, y, r, node}, cheap ones first
let across = null; // the scale of the costs

const isNumber = (value) => typeof value === "number";
const named = (columns, name) => columns.find(({ column }) => column === name);
const inBytes = ({ column }) => column.endsWith("bytes");
const ofPanel = () => rows.filter((row) => row.panel === state.panel);
const drawable = () =>
  ofPanel().filter((row) => isNumber(row[state.cost]) && isNumber(row[state.error]));

// The figures of a row

/** The quartiles of a cost, where it is a time. */
function quartiles(row, cost) {
  const stem = cost.replace(/_median$/, "");
  const found = [row[`${stem}_low`], row[`${stem}_high`]];
  return found.every(isNumber) ? found : null;
}

/** Everything that is known of a row: [label, value, its column]. */
function facts(row) {
  const side = (count) => (count ? `${count} × ${count}` : null);
  const time = (name) => {
    const span = quartiles(row, name);
    return `${figure(row[name])} ms${span ? ` (${span.map(figure).join(" – ")})` : ""}`;
  };
  const list = [["setting", row.setting], ["map", side(row.map_size)],
    ["image", side(row.image_size)], ["bias", row.bias]];
  for (const { column, name } of errors)
    if (isNumber(row[column])) list.push([name, figure(row[column]), column]);
  for (const [column, label] of TIMES)
    if (isNumber(row[column])) list.push([label, time(column), column]);
  if (isNumber(row.kept_bytes)) list.push(["memory kept", bytes(row.kept_bytes), "kept_bytes"]);
  if (typeof row.stable === "boolean") list.push(["steady timing", row.stable ? "yes" : "no"]);
  return list.filter(([, value]) => value);
}

function fill(table, row) {
  table.replaceChildren(...facts(row).map(([label, value, name]) => {
    const head = element("th", { scope: "row" }, label);
    const line = element("tr", {}, head, element("td", {}, value));
    line.classList.toggle("chosen", name === state.cost || name === state.error);
    return line;
  }));
}

// The chart

/** The rows than which none shown is as cheap and closer, or as close and cheaper. */
function front(shown) {
  const best = [];
  const { cost, error } = state;
  for (const row of [...shown].sort((a, b) => a[cost] - b[cost] || a[error] - b[error]))
    if (!best.length || row[error] < best.at(-1)[error]) best.push(row);
  return best;
}

function draw() {
  pointAt(null);
  const { cost, error } = state;
  const [x, y] = [named(costs, cost), named(errors, error)];
  const all = drawable();
  const shown = all.filter((row) => !state.off.has(row.family));
  const lost = ofPanel().length - all.length;
  get("title").textContent = `${state.panel}: ${y.name} against ${x.name}`;
  get("missing").textContent = lost ? `${lost} of ${ofPanel().length} have no such figure.` : "";

  const chart = get("chart"), frame = get("frame").getBoundingClientRect();
  const width = Math.floor(frame.width);
  const room = innerHeight - (frame.top + scrollY) - LEGEND;
  const height = Math.round(Math.max(340, Math.min(0.7 * width, room)));
  const box = { left: MARGIN.left, right: width - MARGIN.right, top: MARGIN.top,
    bottom: height - MARGIN.bottom };
  across = scale(all.map((row) => row[cost]), box.left, box.right, inBytes(x));
  const up = scale(all.map((row) => row[error]), box.bottom, box.top, inBytes(y));

  chart.replaceChildren();
  chart.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const add = (...nodes) => chart.append(...nodes);
  grid(add, box, up, x, y);

  const best = front(shown);
  if (best.length) {
    const at = (row) => [across.place(row[cost]), up.place(row[error])];
    let path = `M${at(best[0])[0]} ${box.top}V${at(best[0])[1]}`;
    for (const row of best.slice(1)) path += `H${at(row)[0]}V${at(row)[1]}`;
    add(svg("path", { class: "front", d: `${path}H${box.right}` }));
  }
  points = shown.map((row) => {
    const family = families[row.family], r = radius(row.map_size);
    const [px, py] = [across.place(row[cost]), up.place(row[error])];
    const node = svg("g", { class: "point", transform: `translate(${px} ${py})`, tabindex: -1,
      role: "button", "aria-label": spoken(row), "data-row": rows.indexOf(row) });
    node.classList.toggle("best", best.includes(row));
    node.classList.toggle("hollow", family.hollow);
    node.append(mark(family, r));
    return { row, x: px, y: py, r, node };
  }).sort((a, b) => a.row[cost] - b.row[cost] || a.row[error] - b.row[error]);
  const weight = (point) => (best.includes(point.row) ? 100 : 0) - point.r;
  add(...[...points].sort((a, b) => weight(a) - weight(b)).map((point) => point.node));
  if (points.length) points[0].node.setAttribute("tabindex", 0);
  names(add, box, points.filter((point) => best.includes(point.row)));
  add(svg("path", { class: "bar", id: "bar" }), svg("circle", { class: "ring", id: "ring" }));
  ring();
}

function spoken(row) {
  const [x, y] = [named(costs, state.cost), named(errors, state.error)];
  const cost = inBytes(x) ? bytes(row[x.column]) : `${figure(row[x.column])} ms`;
  return `${row.name}: ${y.name} ${figure(row[y.column])}, ${x.name} ${cost}`;
}

/** What a column is, which in shading is something else. */
const axis = ({ axis, shading }) => (ofPanel()[0].kind === "shading" && shading) || axis;

function grid(add, box, up, x, y) {
  if (up.zeros) add(svg("rect", { class: "strip", x: box.left, y: up.start,
    width: box.right - box.left, height: box.bottom - up.start }));
  if (across.zeros) add(svg("rect", { class: "strip", x: box.left, y: box.top,
    width: across.start - box.left, height: box.bottom - box.top }));
  const upright = (kind, px) => svg("path", { class: kind, d: `M${px} ${box.top}V${box.bottom}` });
  const level = (kind, py) => svg("path", { class: kind, d: `M${box.left} ${py}H${box.right}` });
  add(...across.minor.map((v) => upright("minor", across.place(v))));
  add(...up.minor.map((v) => level("minor", up.place(v))));
  for (const value of across.ticks) {
    if (value) add(upright("major", across.place(value)));
    add(svg("text", { x: across.place(value), y: box.bottom + 18, "text-anchor": "middle" },
      across.write(value)));
  }
  for (const value of up.ticks) {
    if (value) add(level("major", up.place(value)));
    add(svg("text", { x: box.left - 8, y: up.place(value) + 4, "text-anchor": "end" },
      up.write(value)));
  }
  add(upright("edge", box.left), level("edge", box.bottom));
  add(svg("text", { class: "label", x: (box.left + box.right) / 2, y: box.bottom + 40,
    "text-anchor": "middle" }, axis(x)));
  const turned = `translate(16 ${(box.top + box.bottom) / 2}) rotate(-90)`;
  add(svg("text", { class: "label", transform: turned, "text-anchor": "middle" }, axis(y)));
}

/** Name the points of the front where there is room. */
function names(add, box, best) {
  const taken = points.map(({ x, y, r }) => [x - r, y - r, x + r, y + r]);
  for (const { row, x, y, r } of best) {
    const long = 6.2 * row.name.length, gap = r + 4;
    const heights = [-gap, gap + 8, 4];
    for (const [dx, dy] of [gap, -gap].flatMap((dx) => heights.map((dy) => [dx, dy]))) {
      const left = dx > 0 ? x + dx : x + dx - long;
      const area = [left, y + dy - 10, left + long, y + dy + 3];
      const free = area[0] > box.left && area[2] < box.right + 10 && area[3] < box.bottom &&
        !taken.some((t) => t[0] < area[2] && t[2] > area[0] && t[1] < area[3] && t[3] > area[1]);
      if (!free) continue;
      taken.push(area);
      const anchor = dx > 0 ? "start" : "end";
      add(svg("text", { class: "name", x: x + dx, y: y + dy, "text-anchor": anchor }, row.name));
      break;
    }
  }
}

// What is pointed at

function nearest(event) {
  const box = get("chart").getBoundingClientRect();
  const ratio = get("chart").viewBox.baseVal.width / box.width;
  const [x, y] = [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
  const away = (point) => Math.hypot(point.x - x, point.y - y) - point.r;
  const found = points.reduce((a, b) => (a && away(a) <= away(b) ? a : b), null);
  return found && away(found) < 16 ? found : null;
}

function pointAt(target) {
  const tip = get("tip");
  tip.hidden = !target;
  get("bar")?.removeAttribute("d");
  for (const { node } of points) node.classList.toggle("pointed", node === target?.node);
  if (!target) return;
  const { row, x, y, r } = target;
  const table = element("table");
  fill(table, row);
  const here = points.filter((p) => p !== target && Math.hypot(p.x - x, p.y - y) < 2);
  tip.replaceChildren(element("strong", {}, row.name), table);
  if (here.length) tip.append(`In the same place: ${here.map((p) => p.row.name).join(", ")}`);
  const span = quartiles(row, state.cost);
  if (span) {
    const [a, b] = span.map(across.place);
    get("bar").setAttribute("d", `M${a} ${y - 5}v10M${a} ${y}H${b}M${b} ${y - 5}v10`);
  }
  const box = target.node.getBoundingClientRect();
  const left = box.right + 14 + tip.offsetWidth < innerWidth ? box.right + 14
    : Math.max(4, box.left - 14 - tip.offsetWidth);
  const top = Math.min(box.top, innerHeight - tip.offsetHeight - 8);
  tip.style.left = `${left + scrollX}px`;
  tip.style.top = `${Math.max(8, top) + scrollY}px`;
}

function ring() {
  const chosen = points.find((point) => point.row === state.row);
  const place = chosen ? { cx: chosen.x, cy: chosen.y, r: chosen.r + 5 } : { r: 0 };
  for (const [key, value] of Object.entries(place)) get("ring").setAttribute(key, value);
}

function choose(row) {
  state.row = row;
  ring();
  get("name").textContent = row ? row.name : "";
  const picture = row && pictures[rows.indexOf(row)];
  get("pair").hidden = !picture;
  get("none").hidden = !row || Boolean(picture);
  get("picture").removeAttribute("src");
  if (picture) {
    get("picture").src = `data:image/webp;base64,${picture}`;
    get("picture").alt = `Image of ${row.panel} by ${row.name}, and where it is wrong`;
  }
  if (row) fill(get("facts"), row);
  else get("facts").replaceChildren();
}

/** Move the one tab stop among the points by so many, cheap ones first. */
function step(event) {
  const by = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
  const at = points.findIndex((point) => point.node === document.activeElement);
  if (at < 0) return;
  if (event.key === "Enter" || event.key === " ") choose(points[at].row);
  else if (event.key === "Escape") pointAt(null);
  else if (by) {
    const next = points[(at + by + points.length) % points.length];
    points[at].node.setAttribute("tabindex", -1);
    next.node.setAttribute("tabindex", 0);
    next.node.focus();
  } else return;
  event.preventDefault();
}

// The choices

function options(select, list) {
  select.replaceChildren(...list.map(([value, label]) => element("option", { value }, label)));
}

function legend() {
  const button = (name, act, ...content) => {
    const node = element("button", { type: "button", class: name }, ...content);
    node.addEventListener("click", () => { act(); press(); draw(); });
    return node;
  };
  const swatch = (family, r) => {
    const node = svg("svg", { width: 2.6 * r, height: 2.6 * r,
      viewBox: `${-1.3 * r} ${-1.3 * r} ${2.6 * r} ${2.6 * r}`, "aria-hidden": true });
    node.append(mark(family, r));
    return node;
  };
  const distinct = (name) =>
    [...new Set(ofPanel().map((row) => row[name]))].filter(isNumber).sort((a, b) => a - b);
  const [here, sizes] = [distinct("family"), distinct("map_size")];
  const toggle = (k) => () => state.off.delete(k) || state.off.add(k);
  const family = (k) => button("family", toggle(k), swatch(families[k], 6), families[k].label);
  const buttons = here.map(family);
  const press = () =>
    buttons.forEach((node, k) => node.setAttribute("aria-pressed", !state.off.has(here[k])));
  const gray = { mark: 0, color: "#666" };
  get("families").replaceChildren(
    ...buttons,
    button("plain", () => state.off.clear(), "all"),
    button("plain", () => here.forEach((k) => state.off.add(k)), "none"),
    element("span", { class: "sizes" },
      here.some((k) => families[k].hollow) ? "hollow: another program; " : "",
      sizes.length ? "texels a side:" : "",
      ...sizes.flatMap((size) => [swatch(gray, radius(size)), String(size)])));
  press();
}

/** Show a panel: the errors and costs that it has, and the method chosen before, or the closest. */
function show(panel) {
  state.panel = panel;
  for (const [id, columns] of [["error", errors], ["cost", costs]]) {
    const has = columns.filter(({ column }) => ofPanel().some((row) => isNumber(row[column])));
    options(get(id), has.map(({ column, name }) => [column, name]));
    if (!named(has, state[id])) state[id] = has.length ? has[0].column : columns[0].column;
    get(id).value = state[id];
  }
  legend();
  draw();
  const same = state.row && ofPanel().find((row) => row.name === state.row.name);
  choose(same || front(drawable()).at(-1) || null);
}

for (const id of ["error", "cost"])
  get(id).addEventListener("change", () => {
    state[id] = get(id).value;
    draw();
    choose(state.row);
  });
get("scene").addEventListener("change", () => show(get("scene").value));
get("chart").addEventListener("pointermove", (event) => pointAt(nearest(event)));
get("chart").addEventListener("pointerleave", () => pointAt(null));
get("chart").addEventListener("click", (event) => {
  const target = nearest(event);
  if (target) choose(target.row);
});
get("chart").addEventListener("focusin", (event) =>
  pointAt(points.find((point) => point.node === event.target) || null));
get("chart").addEventListener("focusout", () => pointAt(null));
get("chart").addEventListener("keydown", step);
get("made").textContent = made;
const panels = [...new Set(rows.map((row) => row.panel))];
options(get("scene"), panels.map((panel) => [panel, panel]));
show(panels[0]);
addEventListener("resize", draw);
