// What the progress events draw: the loss over the steps, and how far each pose sweep moved.

import { call } from "./api.js";
import { chart } from "./chart.js";
import { byId } from "./dom.js";

const DRAW_MS = 200;

export class Live {
  constructor(jobId) {
    this.url = `/v1/jobs/${encodeURIComponent(jobId)}/events`;
    this.last = 0;
    this.drawing = null;
    this.draft = null; // the newest event that told of a volume to be seen
    this.restart();
    this.loss = chart({ title: "Residual", xLabel: "step", yLabel: "mean |residual|" });
    this.turn = chart({ title: "Pose motion, rotation", xLabel: "sweep", yLabel: "RMS change, °" });
    this.shift = chart({ title: "Pose motion, translation", xLabel: "sweep", yLabel: "RMS change, mm" });
    byId("live-charts").append(this.loss.node, this.turn.node, this.shift.node);
  }

  restart() {
    Object.assign(this, { step: 0, before: 0, level: null, losses: [], marks: [], turns: [], shifts: [] });
  }

  // Fetches what is new and draws it.
  async refresh() {
    let fresh = true;
    let changed = false;
    while (fresh) {
      const events = (await call(`${this.url}?after=${this.last}`)).events;
      fresh = events.some((event) => event.number > this.last);
      for (const event of events) this.take(event);
      changed ||= fresh;
    }
    if (changed) this.draw();
  }

  take(event) {
    if (event.number <= this.last) return;
    this.last = event.number;
    if (event.attempt !== this.attempt) this.restart(); // a new attempt begins from the start
    this.attempt = event.attempt;
    if (Number.isFinite(event.step)) {
      if (event.step < this.step) this.before += this.step; // steps are counted per level
      this.step = event.step;
    }
    if (event.draft) this.draft = event;
    const x = this.before + this.step;
    if (event.level && event.level !== this.level) {
      this.level = event.level;
      this.marks.push([x, event.level === 1 ? "full" : `1/${event.level}`]);
    }
    if (Number.isFinite(event.loss)) this.losses.push([x, event.loss]);
    if (Number.isFinite(event.moved_deg)) this.turns.push([this.turns.length + 1, event.moved_deg]);
    if (Number.isFinite(event.moved_mm)) this.shifts.push([this.shifts.length + 1, event.moved_mm]);
  }

  // One event of a stream; many come at once, and are drawn together.
  takeNext(event) {
    this.take(event);
    this.drawing ??= setTimeout(() => {
      this.drawing = null;
      this.draw();
    }, DRAW_MS);
  }

  draw() {
    this.loss.node.hidden = this.losses.length === 0;
    this.turn.node.hidden = this.turns.length === 0;
    this.shift.node.hidden = this.shifts.length === 0;
    byId("live-empty").hidden = this.losses.length + this.turns.length > 0;
    this.loss.show([{ name: "residual", points: this.losses }], { log: true, marks: this.marks });
    this.turn.show([{ name: "rotation", points: this.turns }], { log: true });
    this.shift.show([{ name: "translation", points: this.shifts }], { log: true });
  }
}
