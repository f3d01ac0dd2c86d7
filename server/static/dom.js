// Elements and words. Data enters the page as text nodes and attributes only, never as markup.

const SVG = "http://www.w3.org/2000/svg";

function build(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    node.setAttribute(name, value === true ? "" : String(value));
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

export const byId = (id) => document.getElementById(id);
export const el = (tag, attributes = {}, ...children) => build(document.createElement(tag), attributes, children);
export const svg = (tag, attributes = {}, ...children) =>
  build(document.createElementNS(SVG, tag), attributes, children);

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text; // an unchanged status is not announced again
}

export function number(value, digits = 3) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-4 ? value.toExponential(digits - 1) : String(Number(value.toPrecision(digits)));
}

const UNITS = { px: "px", deg: "°", mm: "mm", s: "s" };
const NAMES = { cor: "centre of rotation, column" };
const unitOf = (name) => UNITS[name.split("_").at(-1)];

// "roll_deg" as people say it; its unit goes to the value.
export function plain(name) {
  const bare = unitOf(name) ? name.slice(0, name.lastIndexOf("_")) : name;
  return NAMES[bare] ?? bare.replaceAll("_", " ");
}

export function quantity(name, value) {
  if (value === null) return "not determined";
  if (typeof value !== "number") return String(value);
  const unit = unitOf(name);
  return `${number(value, 6)}${unit ? ` ${unit}` : ""}`;
}

export function bytes(size) {
  for (const unit of ["B", "kB", "MB", "GB"]) {
    if (size < 1000) return `${unit === "B" ? size : size.toFixed(1)} ${unit}`;
    size /= 1000;
  }
  return `${size.toFixed(1)} TB`;
}

export function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
}

export function moment(iso) {
  if (!iso) return el("span", {}, "–");
  const date = new Date(iso);
  const today = date.toDateString() === new Date().toDateString();
  const clock = { hour: "2-digit", minute: "2-digit", hourCycle: "h23" };
  const text = today
    ? date.toLocaleTimeString("en-GB", { ...clock, second: "2-digit" })
    : date.toLocaleString("en-GB", { day: "numeric", month: "short", year: "numeric", ...clock });
  return el("time", { datetime: iso, title: iso }, text);
}

export function took(job) {
  if (!job.started_at) return "–";
  const end = job.finished_at ? Date.parse(job.finished_at) : Date.now();
  return duration((end - Date.parse(job.started_at)) / 1000);
}

// Replaces only the children that changed, so that focus and selection survive a refresh.
export function update(parent, children) {
  children.forEach((child, index) => {
    const old = parent.children[index];
    if (!old) parent.append(child);
    else if (!old.isEqualNode(child)) old.replaceWith(child);
  });
  while (parent.children.length > children.length) parent.lastElementChild.remove();
}

const STATES = ["queued", "running", "cancelling", "succeeded", "failed", "cancelled"];

// The state as a word; colour and shape only repeat it.
export function stateBadge(job) {
  const known = STATES.includes(job.state) ? job.state : "queued";
  return el("span", { class: `state state-${known}` }, job.state);
}

export const place = (job) => (job.queue_position ? `number ${job.queue_position} in line` : "");

export const finished = (job) => ["succeeded", "failed", "cancelled"].includes(job.state);
