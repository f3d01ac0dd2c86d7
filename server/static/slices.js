// Three orthogonal slices with sliders and one grey window.

import { byId, el, setText } from "./dom.js";
import { GreyWindow } from "./greywindow.js";
import { load } from "./picture.js";

const AXES = [
  { axis: "z", name: "Axial", across: "x", up: "y" },
  { axis: "y", name: "Coronal", across: "x", up: "z" },
  { axis: "x", name: "Sagittal", across: "y", up: "z" },
];

const grey = new GreyWindow(() => panes.forEach((pane) => pane.refresh()));
let panes = [];
let turn = 0;

// `voxel` is [z, y, x] in mm; slices of voxels that are no cubes are stretched to their true shape. `draft` is the number
// of the event that told of the volume, where it is one that the run has not finished.
export async function showSlices(jobId, voxel = [1, 1, 1], draft = null) {
  const mine = (turn += 1);
  const base = `/v1/jobs/${encodeURIComponent(jobId)}/slices`;
  const address = (axis, index, window = {}) => {
    const query = new URLSearchParams(draft === null ? window : { ...window, draft }); // each draft its own address
    return `${base}/${axis}/${index}.png?${query}`;
  };
  const [axial, coronal] = await Promise.all([load(address("z", 0)), load(address("y", 0))]);
  const size = { x: axial.naturalWidth, y: axial.naturalHeight, z: coronal.naturalHeight };
  if (mine !== turn) return; // a newer volume has overtaken this one
  const where = Object.fromEntries(panes.map((pane) => [pane.axis, pane.share]));
  await grey.measure((window) => address("z", Math.floor(size.z / 2), window));
  if (mine !== turn) return;
  const mm = { z: voxel[0], y: voxel[1], x: voxel[2] };
  panes = AXES.map((view) => {
    const shape = (size[view.across] * mm[view.across]) / (size[view.up] * mm[view.up]);
    return makePane(address, view, size[view.axis], where[view.axis] ?? 0.5, shape);
  });
  const extent = `${size.x} × ${size.y} × ${size.z} voxels`;
  setText(byId("slices-heading"), draft === null ? "Volume" : `Volume so far, ${extent}`);
  byId("views").replaceChildren(...panes.map((pane) => pane.node));
  byId("slices").hidden = false;
  panes.forEach((pane) => pane.refresh());
}

// What was shown is no longer there, and what is still being fetched is not to appear.
export function hideSlices() {
  turn += 1;
  panes = [];
  byId("views").replaceChildren();
  byId("slices").hidden = true;
}

// `share`: of the way through the volume.
function makePane(address, { axis, name, across, up }, count, share, shape) {
  const picture = el("img", { class: "slice", alt: "" });
  const box = el("div", { class: "slice-box" }, picture);
  picture.style.aspectRatio = String(shape);
  picture.style[shape < 1 ? "height" : "width"] = "100%";
  const slider = el("input", {
    type: "range", min: 0, max: count - 1, value: Math.round((count - 1) * share), "aria-label": `${name} slice, ${axis}`,
  });
  const where = el("output", {});
  let busy = false;
  let wanted = null;

  // One request at a time; while it runs only the newest wish is kept.
  async function refresh() {
    setText(where, `${axis} ${slider.value} of ${count - 1}`);
    wanted = address(axis, slider.value, grey.window);
    if (busy) return;
    busy = true;
    while (wanted) {
      const url = wanted;
      wanted = null;
      try {
        picture.src = (await load(url)).src;
        picture.alt = `${name} slice at ${where.textContent}; ${across} to the right, ${up} up`;
      } catch (error) {
        picture.alt = error.message;
      }
    }
    busy = false;
  }

  slider.addEventListener("input", () => {
    share = slider.valueAsNumber / Math.max(count - 1, 1);
    refresh();
  });
  const axes = el("span", { class: "muted" }, `${across} →, ${up} ↑`);
  const caption = el("figcaption", {}, el("strong", {}, name), axes, el("span", { class: "muted" }, where));
  return {
    axis,
    node: el("figure", { class: "view" }, caption, box, slider),
    get share() {
      return share;
    },
    refresh,
  };
}
