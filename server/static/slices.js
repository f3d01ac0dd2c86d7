// Three orthogonal slices with sliders and one grey window.

import { byId, el, setText } from "./dom.js";
import { GreyWindow } from "./greywindow.js";
import { load } from "./picture.js";

const AXES = [
  { axis: "z", name: "Axial", across: "x", up: "y" },
  { axis: "y", name: "Coronal", across: "x", up: "z" },
  { axis: "x", name: "Sagittal", across: "y", up: "z" },
];

// `voxel` is [z, y, x] in mm; slices of voxels that are no cubes are stretched to their true shape.
export async function showSlices(jobId, voxel = [1, 1, 1]) {
  const base = `/v1/jobs/${encodeURIComponent(jobId)}/slices`;
  const [axial, coronal] = await Promise.all([load(`${base}/z/0.png`), load(`${base}/y/0.png`)]);
  const size = { x: axial.naturalWidth, y: axial.naturalHeight, z: coronal.naturalHeight };
  let panes = [];
  const grey = new GreyWindow(() => panes.forEach((pane) => pane.refresh()));
  await grey.measure(`${base}/z/${Math.floor(size.z / 2)}.png`);
  const mm = { z: voxel[0], y: voxel[1], x: voxel[2] };
  panes = AXES.map((view) => {
    const shape = (size[view.across] * mm[view.across]) / (size[view.up] * mm[view.up]);
    return makePane(base, view, size[view.axis], grey, shape);
  });
  byId("views").replaceChildren(...panes.map((pane) => pane.node));
  byId("slices").hidden = false;
  panes.forEach((pane) => pane.refresh());
}

function makePane(base, { axis, name, across, up }, count, grey, shape) {
  const picture = el("img", { class: "slice", alt: "" });
  const box = el("div", { class: "slice-box" }, picture);
  picture.style.aspectRatio = String(shape);
  picture.style[shape < 1 ? "height" : "width"] = "100%";
  const slider = el("input", {
    type: "range", min: 0, max: count - 1, value: Math.floor(count / 2), "aria-label": `${name} slice, ${axis}`,
  });
  const where = el("output", {});
  let busy = false;
  let wanted = null;

  // One request at a time; while it runs only the newest wish is kept.
  async function refresh() {
    setText(where, `${axis} ${slider.value} of ${count - 1}`);
    wanted = `${base}/${axis}/${slider.value}.png${grey.query}`;
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

  slider.addEventListener("input", refresh);
  const axes = el("span", { class: "muted" }, `${across} →, ${up} ↑`);
  const caption = el("figcaption", {}, el("strong", {}, name), axes, el("span", { class: "muted" }, where));
  return { node: el("figure", { class: "view" }, caption, box, slider), refresh };
}
