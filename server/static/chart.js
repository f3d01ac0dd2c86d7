// A line chart as SVG: linear or logarithmic y, error bars, marks, a read-out under the pointer.
// x counts something: views, steps, sweeps. series: [{name, points: [[x, y, sigma?], ...]}], at most three.

import { el, number, svg } from "./dom.js";

const HEIGHT = 220;
const MARGIN = { left: 58, right: 14, top: 12, bottom: 40 };

export function chart({ title, xLabel, yLabel }) {
  const caption = el("figcaption", {}, el("strong", {}, title));
  const legend = el("span", { class: "legend" });
  const readout = el("output", { class: "readout" });
  const canvas = el("div", { class: "canvas" });
  caption.append(legend, readout);
  const node = el("figure", { class: "chart" }, caption, canvas);
  let last = null;
  const redraw = () => last && canvas.clientWidth && draw(canvas, readout, { title, xLabel, yLabel, ...last });
  new ResizeObserver(redraw).observe(canvas);
  return {
    node,
    show(series, { log = false, marks = [] } = {}) {
      last = { series, log, marks };
      const names = series.length > 1 ? series.map((s, i) => el("span", { class: `key series-${i}` }, s.name)) : [];
      legend.replaceChildren(...names);
      redraw();
    },
  };
}

function draw(canvas, readout, { title, xLabel, yLabel, series, log, marks }) {
  const width = canvas.clientWidth;
  const look = (index) => (series.length > 1 ? `series-${index}` : "series-only");
  const usable = (y) => Number.isFinite(y) && (!log || y > 0);
  const shown = series.map((s) => ({ ...s, points: s.points.filter(([x, y]) => Number.isFinite(x) && usable(y)) }));
  const all = shown.flatMap((s) => s.points);
  if (all.length === 0) {
    canvas.replaceChildren();
    return;
  }
  const bars = all.flatMap(([, y, sigma]) => (Number.isFinite(sigma) ? [y - sigma, y + sigma] : [y])).filter(usable);
  const xs = all.map((p) => p[0]);
  const [x0, x1] = spread(least(xs), most(xs));
  const yRange = log ? [least(bars), most(bars)].map(Math.log10) : [least([...bars, 0]), most([...bars, 0])];
  const [y0, y1] = padded(spread(...yRange));
  const right = width - MARGIN.right;
  const bottom = HEIGHT - MARGIN.bottom;
  const px = (x) => MARGIN.left + ((x - x0) / (x1 - x0)) * (right - MARGIN.left);
  const py = (y) => bottom - (((log ? Math.log10(y) : y) - y0) / (y1 - y0)) * (bottom - MARGIN.top);

  const yTicks = log ? decades(y0, y1) : ticks(y0, y1, 5);
  const grid = yTicks.flatMap((y) => [
    svg("line", { class: "grid", x1: MARGIN.left, x2: right, y1: py(y), y2: py(y) }),
    svg("text", { class: "tick", x: MARGIN.left - 8, y: py(y) + 4, "text-anchor": "end" }, number(y)),
  ]);
  const xTicks = ticks(x0, x1, Math.max(2, Math.floor(width / 75)), 1).map((x) =>
    svg("text", { class: "tick", x: px(x), y: bottom + 16, "text-anchor": "middle" }, number(x, 6)),
  );
  const lines = marks.filter(([x]) => x >= x0 && x <= x1).flatMap(([x, text]) => [
    svg("line", { class: "mark", x1: px(x), x2: px(x), y1: MARGIN.top, y2: bottom }),
    svg("text", { class: "tick", x: px(x) + 4, y: MARGIN.top + 9 }, text),
  ]);
  const curves = shown.flatMap((s, i) => [
    svg("path", { class: `bars ${look(i)}`, d: s.points.map((p) => bar(p, px, py, usable)).join("") }),
    svg("path", { class: `curve ${look(i)}`, d: s.points.map((p, k) => `${k ? "L" : "M"}${px(p[0])} ${py(p[1])}`).join("") }),
    ...(s.points.length < 60 ? s.points.map((p) => svg("circle", { class: `dot ${look(i)}`, cx: px(p[0]), cy: py(p[1]), r: 2.2 })) : []),
  ]);
  const cursor = svg("line", { class: "cursor", y1: MARGIN.top, y2: bottom, visibility: "hidden" });
  const described = `${title}: ${yLabel} over ${xLabel}, ${all.length} points from ${number(least(bars))} to ${number(most(bars))}`;
  const picture = svg(
    "svg",
    { viewBox: `0 0 ${width} ${HEIGHT}`, width, height: HEIGHT, role: "img", "aria-label": described },
    ...grid, ...xTicks, ...lines,
    svg("line", { class: "axis", x1: MARGIN.left, x2: right, y1: bottom, y2: bottom }),
    svg("text", { class: "label", x: (MARGIN.left + right) / 2, y: HEIGHT - 6, "text-anchor": "middle" }, xLabel),
    svg("text", { class: "label", transform: `translate(12 ${(MARGIN.top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, yLabel),
    ...curves, cursor,
  );
  picture.addEventListener("pointermove", (event) => {
    const at = x0 + ((event.offsetX - MARGIN.left) / (right - MARGIN.left)) * (x1 - x0);
    const near = shown.filter((s) => s.points.length).map((s) => [s.name, nearest(s.points, at)]);
    cursor.setAttribute("visibility", "visible");
    cursor.setAttribute("x1", px(near[0][1][0]));
    cursor.setAttribute("x2", px(near[0][1][0]));
    const values = near.map(([name, p]) => `${name} ${number(p[1])}${Number.isFinite(p[2]) ? ` ± ${number(p[2], 2)}` : ""}`);
    readout.textContent = `${xLabel} ${number(near[0][1][0], 6)}: ${values.join(", ")}`;
  });
  picture.addEventListener("pointerleave", () => {
    cursor.setAttribute("visibility", "hidden");
    readout.textContent = "";
  });
  canvas.replaceChildren(picture);
}

const least = (values) => values.reduce((a, b) => Math.min(a, b), Infinity);
const most = (values) => values.reduce((a, b) => Math.max(a, b), -Infinity);
const nearest = (points, x) => points.reduce((a, b) => (Math.abs(b[0] - x) < Math.abs(a[0] - x) ? b : a));

function bar([x, y, sigma], px, py, usable) {
  if (!Number.isFinite(sigma) || !usable(y - sigma)) return "";
  return `M${px(x)} ${py(y - sigma)}V${py(y + sigma)}`;
}

const padded = ([low, high]) => [low - 0.05 * (high - low), high + 0.1 * (high - low)];

function spread(low, high) {
  if (high - low > 1e-12 * Math.max(Math.abs(low), Math.abs(high))) return [low, high];
  const room = Math.abs(low) * 0.5 || 0.5;
  return [low - room, high + room];
}

function ticks(low, high, count, finest = 0) {
  const raw = Math.max((high - low) / count, finest);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= raw);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k += 1) found.push(k * step);
  return found;
}

function decades(low, high) {
  if (high - low < 0.7) return ticks(10 ** low, 10 ** high, 4).filter((y) => y > 0);
  const found = [];
  const factors = high - low > 2.5 ? [1] : [1, 2, 5];
  for (let power = Math.floor(low); power <= high; power += 1) {
    found.push(...factors.map((factor) => factor * 10 ** power));
  }
  return found.filter((y) => Math.log10(y) >= low - 1e-9 && Math.log10(y) <= high + 1e-9);
}
