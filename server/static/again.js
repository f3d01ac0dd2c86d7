// The form that runs a job's scan again: the options that the server knows, as this job had them.

import { call, notice } from "./api.js";
import { byId, el } from "./dom.js";

// Shown once, for a job that has finished; `url` is the job's.
export async function offerAgain(url, job) {
  const { options } = await call("/v1/options");
  const fields = options.map((option) => ({ option, node: field(option, job.options?.[option.name]) }));
  byId("again-options").replaceChildren(...fields.map(({ option, node }) => labelled(option, node)));
  byId("again-name").value = job.name ?? "";
  byId("again-priority").value = job.priority;
  byId("again-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const changed = fields.filter(({ option, node }) => node.value !== text(job.options?.[option.name]));
    const body = {
      options: Object.fromEntries(changed.map(({ option, node }) => [option.name, value(option, node.value)])),
      priority: byId("again-priority").value,
    };
    if (byId("again-name").value) body.name = byId("again-name").value;
    byId("again-submit").disabled = true;
    try {
      const made = await call(`${url}/restart`, { method: "POST", body: JSON.stringify(body) });
      location.assign(`/jobs/${encodeURIComponent(made.id)}`);
    } catch (error) {
      notice(error.message);
      byId("notice").scrollIntoView();
      byId("again-submit").disabled = false;
    }
  });
  byId("again").hidden = false;
}

function field(option, now) {
  const id = `option-${option.name}`;
  const truth = typeof option.default === "boolean" ? ["true", "false"] : null;
  const choices = option.choices ?? truth;
  if (!choices) {
    const node = el("input", { id, inputmode: option.low === null ? null : "decimal", autocomplete: "off" });
    node.value = text(now);
    return node;
  }
  const all = option.default === null ? ["", ...choices] : choices;
  const node = el("select", { id }, ...all.map((choice) => el("option", { value: choice }, String(choice) || "automatic")));
  node.value = text(now);
  return node;
}

function labelled(option, node) {
  const hint = el("span", { class: "muted", id: `${node.id}-hint` }, option.help ?? "");
  node.setAttribute("aria-describedby", hint.id);
  if (node.tagName === "INPUT") node.placeholder = option.default === null ? "automatic" : String(option.default);
  return el("div", { class: "field" }, el("label", { for: node.id }, option.name), node, hint);
}

const text = (value) => (value === null || value === undefined ? "" : String(value));

// As the API wants it: numbers and truth values as such, nothing for the default.
function value(option, given) {
  if (given.trim() === "") return option.default;
  if (option.choices) return option.choices.find((choice) => String(choice) === given);
  if (given === "true" || given === "false") return given === "true";
  const number = Number(given);
  return Number.isNaN(number) ? given : number;
}
