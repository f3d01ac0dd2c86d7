// Per-view corrections with their uncertainty, and the scanner's constant errors.

import { call } from "./api.js";
import { chart } from "./chart.js";
import { byId, el, plain, quantity } from "./dom.js";

export async function showPoses(url) {
  const poses = await call(url);
  const views = poses.views ?? [];
  const turn = chart({ title: "Rotation", xLabel: "view", yLabel: "about x, y, z, °" });
  const shift = chart({ title: "Translation", xLabel: "view", yLabel: "along x, y, z, mm" });
  const residual = chart({ title: "Residual", xLabel: "view", yLabel: "RMS residual" });
  byId("pose-charts").replaceChildren(turn.node, shift.node, residual.node);
  byId("poses").hidden = false; // before drawing: a hidden chart has no width
  turn.show(components(views, "rotation_deg"));
  shift.show(components(views, "translation_mm"));
  residual.show([{ name: "residual", points: views.map((view) => [view.index, view.residual_rms]) }]);
  residual.node.hidden = !views.some((view) => Number.isFinite(view.residual_rms));
  const notes = (poses.notes ?? []).map((note) => el("p", { class: "muted" }, note));
  byId("static").replaceChildren(...notes, ...constants(poses.static ?? {}));
}

function components(views, key) {
  return ["x", "y", "z"].map((name, axis) => ({
    name,
    points: views.map((view) => [view.index, view.correction?.[key]?.[axis], view.sigma?.[key]?.[axis]]),
  }));
}

function constants(found) {
  const rows = Object.entries(found).map(([name, value]) => [el("dt", {}, plain(name)), el("dd", {}, quantity(name, value))]);
  if (rows.length === 0) return [];
  return [el("h3", {}, "Constant over the scan"), el("dl", { class: "facts" }, ...rows.flat())];
}
