// The list of jobs, newest first, live: the newest come by a stream, older ones when asked for.

import { call, notice } from "./api.js";
import { byId, duration, el, finished, moment, place, setText, stateBadge, took } from "./dom.js";
import { listen } from "./stream.js";

const MOST = 500; // jobs that one request may ask for
const PAGE = 50; // as many as the stream tells of
let jobs = []; // that are shown
let reached = false; // "Show older jobs" was used: what is pushed out of the newest stays

function progressCell(job) {
  const percent = Math.round(job.progress * 100);
  const eta = job.eta_s && !finished(job) ? `, ${duration(job.eta_s)} left` : "";
  if (job.state === "failed") return el("p", { class: "why" }, job.error?.message ?? "");
  if (job.state === "queued") return el("p", { class: "muted" }, [job.message, place(job)].filter(Boolean).join(", "));
  if (finished(job)) return el("p", { class: "muted" }, job.message ?? "");
  return el(
    "div",
    { class: "doing" },
    el("progress", { max: 1, value: job.progress, "aria-label": `${percent} % done` }),
    el("p", { class: "muted" }, `${percent} %${eta}${job.message ? ` · ${job.message}` : ""}`),
  );
}

function row(job) {
  const name = job.name || job.scan_name || "unnamed";
  const link = el("a", { href: `/jobs/${encodeURIComponent(job.id)}` }, name);
  const scan = job.scan_name && job.scan_name !== name ? el("p", { class: "muted" }, job.scan_name) : null;
  return el(
    "tr",
    { "data-id": job.id },
    el("th", { scope: "row" }, link, scan),
    el("td", { "data-label": "State" }, stateBadge(job)),
    el("td", { "data-label": "Progress" }, progressCell(job)),
    el("td", { "data-label": "Submitted" }, moment(job.created_at)),
    el("td", { "data-label": "Took" }, took(job)),
  );
}

// Rows are replaced only where something changed, so that focus and selection survive.
function show() {
  const body = byId("rows");
  const before = new Map([...body.children].map((node) => [node.dataset.id, node]));
  const focused = document.activeElement?.closest?.("tr")?.dataset.id;
  const rows = jobs.map((job) => {
    const fresh = row(job);
    const kept = before.get(job.id);
    return kept && kept.isEqualNode(fresh) ? kept : fresh;
  });
  if (rows.length !== body.children.length || rows.some((node, index) => node !== body.children[index])) {
    body.replaceChildren(...rows);
    if (focused) rows.find((node) => node.dataset.id === focused)?.querySelector("a")?.focus();
  }
  byId("list").hidden = jobs.length === 0;
  byId("list").setAttribute("aria-busy", "false");
  byId("empty").hidden = jobs.length > 0;
}

function count(more) {
  const active = { running: 0, queued: 0 };
  for (const job of jobs) if (job.state in active) active[job.state] += 1;
  const parts = [`${active.running} running`, `${active.queued} waiting`, `${jobs.length}${more ? " newest" : ""} listed`];
  setText(byId("counts"), jobs.length ? parts.join(" · ") : "");
}

// `newest`: jobs from the newest on, without a gap. What is not among them and no older was deleted. If none of those
// shown before is the oldest of them, jobs may be missing in between: older ones are to be asked for again.
function take(newest, more) {
  const last = newest.at(-1);
  if (last && more && !jobs.some(({ id }) => id === last.id)) reached = false;
  const oldest = Date.parse(last?.created_at ?? 0);
  const rest = jobs.filter((job) => Date.parse(job.created_at) < oldest && newest.every(({ id }) => id !== job.id));
  jobs = [...newest, ...(reached ? rest : [])];
  if (!reached) byId("older").hidden = !more;
  show();
  count(!byId("older").hidden);
}

function hear({ ids, jobs: changed, more }) {
  const known = new Map([...jobs, ...changed].map((job) => [job.id, job]));
  take(ids.map((id) => known.get(id)), more);
}

// Where there is no stream.
async function refresh() {
  const page = await call(`/v1/jobs?limit=${PAGE}`);
  take(page.jobs, page.next !== null);
  return jobs.some((job) => !finished(job)) ? 2000 : 5000;
}

// When a job waits and none runs, say why, if the server knows. No news comes of a job that goes on waiting.
let told = "";

async function lookForWorkers() {
  const waits = jobs.some((job) => job.state === "queued" && Date.now() - Date.parse(job.created_at) > 15000);
  const now = waits && !jobs.some((job) => job.state === "running") ? await obstacle() : "";
  if (now !== told) notice(now); // and leave other notices alone
  told = now;
}

// No stream tells of jobs that are not among the newest.
async function lookAtOlder() {
  if (!reached || jobs.length <= PAGE) return;
  const last = jobs[PAGE - 1];
  const asked = new Set(jobs.slice(PAGE, PAGE + MOST).map(({ id }) => id));
  const count = asked.size;
  const page = await call(`/v1/jobs?limit=${count}&before=${encodeURIComponent(last.id)}`);
  const from = jobs.findIndex(({ id }) => id === last.id) + 1; // newer ones may have come meanwhile
  if (from === 0) return; // it was deleted: next time
  const found = new Set(page.jobs.map(({ id }) => id));
  const beyond = jobs.slice(from).filter(({ id }) => !asked.has(id) && !found.has(id));
  jobs = [...jobs.slice(0, from), ...page.jobs, ...beyond];
  show();
  if (page.jobs.length === count) return;
  byId("older").hidden = page.next === null;
}

async function obstacle() {
  const ready = await (await fetch("/readyz")).json();
  if (!ready.database) return "The server cannot write to its database.";
  if (!ready.redis) return "The queue does not answer: jobs are safe in the database and wait for Redis.";
  if (!ready.workers) return "No worker is alive, so jobs wait. Start one with: splatct worker";
  return "";
}

async function showOlder() {
  const last = jobs.at(-1);
  if (!last) return;
  try {
    const page = await call(`/v1/jobs?limit=${PAGE}&before=${encodeURIComponent(last.id)}`);
    reached = true;
    jobs = [...jobs, ...page.jobs.filter((job) => jobs.every(({ id }) => id !== job.id))];
    byId("older").hidden = page.next === null;
    show();
    count(!byId("older").hidden);
  } catch (error) {
    notice(error.message);
  }
}

async function copy() {
  try {
    await navigator.clipboard.writeText(byId("command").textContent);
    setText(byId("copy"), "Copied");
  } catch {
    getSelection().selectAllChildren(byId("command")); // no clipboard on plain http: select it instead
    setText(byId("copy"), "Selected");
  }
  setTimeout(() => setText(byId("copy"), "Copy"), 2000);
}

setText(byId("command"), `splatct submit SCAN_FOLDER --server ${location.origin} -o RESULTS`);
byId("older").addEventListener("click", showOlder);
byId("copy").addEventListener("click", copy);
listen(() => "/v1/events", { jobs: hear }, refresh, (error) => notice(error.message));
setInterval(() => document.hidden || lookAtOlder().catch(() => {}), 10000);
setInterval(() => document.hidden || lookForWorkers().catch(() => {}), 2000); // the stream tells if the server is away
