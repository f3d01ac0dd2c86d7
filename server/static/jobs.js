// The list of jobs, newest first, kept fresh.

import { call, keepFresh, notice } from "./api.js";
import { byId, duration, el, finished, moment, place, setText, stateBadge, took } from "./dom.js";

const PAGE = 50;
let older = []; // what "Show older jobs" has brought; not refreshed

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
function show(jobs) {
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

function count(jobs, more) {
  const active = { running: 0, queued: 0 };
  for (const job of jobs) if (job.state in active) active[job.state] += 1;
  const parts = [`${active.running} running`, `${active.queued} waiting`, `${jobs.length}${more ? " newest" : ""} listed`];
  setText(byId("counts"), jobs.length ? parts.join(" · ") : "");
}

async function refresh() {
  const page = await call(`/v1/jobs?limit=${PAGE}`);
  const known = new Set(page.jobs.map((job) => job.id));
  const jobs = [...page.jobs, ...older.filter((job) => !known.has(job.id))];
  if (older.length === 0) byId("older").hidden = page.next === null;
  show(jobs);
  await lookForWorkers(jobs);
  count(jobs, !byId("older").hidden);
  return jobs.some((job) => !finished(job)) ? 2000 : 5000;
}

// When a job waits and none runs, say why, if the server knows.
async function lookForWorkers(jobs) {
  const waits = jobs.some((job) => job.state === "queued" && Date.now() - Date.parse(job.created_at) > 15000);
  if (!waits || jobs.some((job) => job.state === "running")) return notice("");
  const ready = await (await fetch("/readyz")).json();
  if (!ready.database) return notice("The server cannot write to its database.");
  if (!ready.redis) return notice("The queue does not answer: jobs are safe in the database and wait for Redis.");
  if (!ready.workers) return notice("No worker is alive, so jobs wait. Start one with: splatct worker");
  return notice("");
}

async function showOlder() {
  const last = byId("rows").lastElementChild?.dataset.id;
  if (!last) return;
  try {
    const page = await call(`/v1/jobs?limit=${PAGE}&before=${encodeURIComponent(last)}`);
    older = [...older, ...page.jobs];
    byId("rows").append(...page.jobs.map(row));
    byId("older").hidden = page.next === null;
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
keepFresh(refresh, (error) => notice(error.message));
