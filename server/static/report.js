// The verdict and the findings behind it.

import { call } from "./api.js";
import { byId, el, plain, quantity, setText } from "./dom.js";

export async function showReport(jobId) {
  const report = await call(`/v1/jobs/${encodeURIComponent(jobId)}/report`);
  setText(byId("verdict-text"), [report.verdict ?? []].flat().join("\n"));
  const worstFirst = (report.findings ?? []).toSorted((a, b) => rank(a) - rank(b));
  byId("findings").replaceChildren(...worstFirst.map(finding));
  byId("verdict").hidden = false;
}

const SEVERITIES = ["problem", "warning", "note", "ok"];
const rank = ({ severity }) => (SEVERITIES.indexOf(severity) + SEVERITIES.length + 1) % (SEVERITIES.length + 1);

// What fits on a line; longer evidence is in report.html.
const isShort = (value) =>
  value === null || typeof value !== "object" || (Array.isArray(value) && value.length <= 12 && value.every(isShort));

function finding({ name, severity, text, evidence }) {
  const look = SEVERITIES.includes(severity) ? severity : "note";
  const facts = Object.entries(evidence ?? {}).filter(([, value]) => isShort(value));
  const list = facts.flatMap(([key, value]) => [
    el("dt", {}, plain(key)),
    el("dd", {}, [value].flat().map((one) => quantity(key, one)).join(", ")),
  ]);
  return el(
    "li",
    { class: `finding finding-${look}` },
    el("p", { class: "finding-head" }, el("strong", {}, String(name).replaceAll("_", " ")), el("span", { class: "badge" }, String(severity))),
    el("p", {}, text ?? ""),
    facts.length ? el("details", {}, el("summary", {}, "Evidence"), el("dl", { class: "facts" }, ...list)) : null,
  );
}
