// One job: progress while it runs, results once it has them.

import { Actions } from "./actions.js";
import { offerAgain } from "./again.js";
import { call, keepFresh, notice } from "./api.js";
import { byId, bytes, duration, el, finished, moment, place, setText, stateBadge, took, update } from "./dom.js";
import { follow } from "./follow.js";
import { showLogOf } from "./joblog.js";
import { Live } from "./live.js";
import { showPoses } from "./poses.js";
import { showReport } from "./report.js";
import { hideSlices, showSlices } from "./slices.js";

const id = byId("job").dataset.id;
const url = `/v1/jobs/${encodeURIComponent(id)}`;
const STAGES = [["read", "Read"], ["start", "First volume"], ["level", "Fit splats and poses"], ["diagnose", "Diagnose"], ["write", "Write"]];

const actions = new Actions(url, show);
let live = null;
let draftShown = null;
let endShown = false;

function show(job) {
  const name = job.name || job.scan_name || "unnamed";
  setText(byId("name"), name);
  const percent = finished(job) || job.state === "queued" ? job.state : `${Math.round(job.progress * 100)} %`;
  document.title = `${percent} · ${name} · SplatCT`;
  update(byId("state"), [stateBadge(job)]);
  actions.show(job);

  byId("progress-panel").hidden = finished(job);
  byId("bar").value = job.progress;
  setText(byId("message"), [job.message, job.state === "queued" ? place(job) : ""].filter(Boolean).join(", "));
  setText(byId("eta"), job.eta_s ? `about ${duration(job.eta_s)} left` : "");
  showStages(job.stage);

  byId("failure").hidden = job.state !== "failed";
  setText(byId("failure-text"), job.error?.message ?? "The server gave no reason.");
  showDetails(job);
}

function showStages(stage) {
  const shown = ["poses", "refine", "checkpoint"].includes(stage) ? "level" : stage; // they take turns, or tell of it
  const now = STAGES.findIndex(([name]) => name === shown);
  const nodes = STAGES.map(([, text], index) =>
    el("li", { class: index < now ? "past" : index === now ? "now" : "ahead", "aria-current": index === now ? "step" : null }, text),
  );
  update(byId("stages"), nodes);
}

function showDetails(job) {
  const options = Object.entries(job.options ?? {}).map(([name, value]) => `${name} = ${value === null ? "automatic" : value}`);
  const rows = [
    ["Scan", job.scan_name],
    ["Submitted", moment(job.created_at)],
    ["Started", moment(job.started_at)],
    ["Finished", moment(job.finished_at)],
    ["Took", took(job)],
    ["Attempt", String(job.attempt)],
    ["Options", options.join(", ") || "all at their defaults"],
    ["Job", el("code", {}, job.id)],
    ["Priority", job.priority],
    ["Restart of", job.restart_of ? el("a", { href: `/jobs/${encodeURIComponent(job.restart_of)}` }, "an earlier job") : null],
  ];
  update(byId("facts"), rows.filter(([, value]) => value !== null).flatMap(([name, value]) => [el("dt", {}, name), el("dd", {}, value ?? "–")]));
  byId("details").hidden = false;
}

async function showResults(kind) {
  const manifest = await call(`${url}/${kind}`);
  const files = manifest.files;
  if (kind === "partial") setText(byId("fetch-command"), `splatct fetch ${id} --partial -o RESULTS`);
  setText(byId("files-heading"), kind === "partial" ? "Files of the partial result" : "Files");
  const path = (file) => `${url}/${kind}/${file.name.split("/").map(encodeURIComponent).join("/")}`;
  byId("file-rows").replaceChildren(
    ...[...files, { name: "manifest.json" }].map((file) =>
      el(
        "tr",
        {},
        el("th", { scope: "row" }, el("a", { href: path(file), download: file.name.endsWith(".html") ? null : true }, file.name)),
        el("td", {}, file.sha256 ? bytes(file.size) : ""),
        el("td", {}, file.sha256 ? el("code", { title: file.sha256 }, `${file.sha256.slice(0, 12)}…`) : ""),
      ),
    ),
  );
  byId("files").hidden = false;
  const named = new Map(files.map((file) => [file.name, file]));
  const parts = [];
  if (named.has("report.json")) parts.push(showReport(id));
  if (named.has("volume.tif")) parts.push(showSlices(id, manifest.volume?.voxel_mm));
  if (named.has("poses.json")) parts.push(showPoses(path(named.get("poses.json"))));
  const failed = (await Promise.allSettled(parts)).filter((part) => part.status === "rejected");
  if (failed.length) notice(`Some results cannot be shown: ${failed.map((part) => part.reason.message).join("; ")}`);
}

function curves() {
  live ??= new Live(id);
  return live;
}

async function refresh() {
  const job = await call(url);
  show(job);
  if (job.state !== "queued" || job.attempt > 1) {
    await curves().refresh();
    showCurves(job);
    if (!finished(job)) showDraft();
  }
  await showEnd(job);
  return finished(job) ? null : 2000;
}

function showCurves(job) {
  byId("live").hidden = live === null || (finished(job) && live.last === 0);
}

// The volume as it stands. It may be gone again when it is asked for: the next one, or the end, is told of, too.
function showDraft() {
  const draft = live.draft;
  if (draft === draftShown) return;
  draftShown = draft;
  showSlices(id, draft.draft.voxel_mm, draft.number).catch(() => {
    if (draftShown === draft && !endShown) setText(byId("slices-heading"), "Volume so far, not shown");
  });
}

// What only a job that has ended has: results, whole or partial, and another run.
async function showEnd(job) {
  if (!finished(job) || endShown) return;
  endShown = true;
  const kind = job.state === "succeeded" ? "results" : job.links?.partial ? "partial" : null;
  if (kind === null) hideSlices();
  await actions.known;
  const parts = [kind ? showResults(kind) : null, actions.may("submit") ? offerAgain(url, job) : null];
  const failed = (await Promise.allSettled(parts)).filter((part) => part.status === "rejected");
  if (failed.length) notice(`Some of it cannot be shown: ${failed.map((part) => part.reason.message).join("; ")}`);
}

function refused(error) {
  const missing = error.status === 404 || error.status === 422;
  setText(byId("name"), missing ? "No such job" : "Job");
  notice(missing ? "This server has no such job. It may have been deleted; the list of jobs shows the rest." : error.message);
}

// First all that there is, then what happens from here on.
async function begin() {
  const pause = await refresh();
  if (pause === null) return null;
  follow(url, {
    take(event) {
      curves().takeNext(event);
      byId("live").hidden = false;
      showDraft();
    },
    show,
    async end(job) {
      if (!job.id) return refused({ status: 404 });
      show(job);
      showCurves(job);
      await showEnd(job);
    },
    last: () => live?.last ?? 0,
    poll: refresh,
    refused,
  });
  return null;
}

setText(byId("fetch-command"), `splatct fetch ${id} --server ${location.origin} -o RESULTS`);
showLogOf(url);
keepFresh(begin, refused);
