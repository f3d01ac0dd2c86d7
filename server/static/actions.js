// What can be done with a job: another place in the queue, a pin, an end, a deletion. Only what the key is good for shows.

import { call, notice, session } from "./api.js";
import { byId, finished, setText } from "./dom.js";

export class Actions {
  // url: of the job; changed(job): called with what an action made of it.
  constructor(url, changed) {
    Object.assign(this, { url, changed, job: null, scopes: [] });
    this.known = session().then(
      (mine) => {
        this.scopes = mine.scopes;
        if (this.job) this.show(this.job);
      },
      () => {}, // the page's own calls tell what is wrong
    );
    byId("cancel").addEventListener("click", () => this.cancel());
    byId("priority").addEventListener("change", ({ target }) => this.send("", "PATCH", { priority: target.value }));
    byId("pin").addEventListener("click", () => this.send("/pin", this.job.pinned ? "DELETE" : "POST"));
    byId("delete").addEventListener("click", () => this.remove());
  }

  may(scope) {
    return this.scopes.includes(scope) || this.scopes.includes("admin");
  }

  show(job) {
    this.job = job;
    const active = !finished(job);
    byId("cancel").hidden = !active || !this.may("submit");
    byId("cancel").disabled = job.state === "cancelling";
    byId("place").hidden = !active || !this.may("submit");
    if (document.activeElement !== byId("priority")) byId("priority").value = job.priority;
    byId("pin").hidden = !this.may(job.pinned ? "delete" : "submit");
    byId("pin").setAttribute("aria-pressed", String(job.pinned));
    setText(byId("pin"), job.pinned ? "Pinned" : "Pin");
    byId("delete").hidden = active || !this.may("delete");
  }

  async send(path, method, body) {
    try {
      const more = body ? { body: JSON.stringify(body) } : {};
      this.changed(await call(`${this.url}${path}`, { method, ...more }));
      notice("");
    } catch (error) {
      notice(error.message);
      this.show(this.job);
    }
  }

  cancel() {
    if (!confirm("Cancel this job? What it has computed so far is kept as a partial result.")) return;
    this.send("/cancel", "POST");
  }

  async remove() {
    if (!confirm("Delete this job and its results? They cannot be brought back. The scan stays.")) return;
    try {
      await call(this.url, { method: "DELETE" });
      location.assign("/");
    } catch (error) {
      notice(error.message);
    }
  }
}
