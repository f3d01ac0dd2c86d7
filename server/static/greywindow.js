// Which attenuation is black and which is white. The volume's range is measured through the slices
// themselves: a slice drawn with a known window tells its values, each look a hundred times finer.

import { byId, number, setText } from "./dom.js";
import { load } from "./picture.js";

const FIRST = [-10, 10]; // 1/mm; no material in an X-ray scan comes near it
const LOOKS = 3;
const STEPS = 500;

export class GreyWindow {
  constructor(onChange) {
    this.onChange = onChange;
    this.chosen = false; // by the user, who keeps it when another volume is shown
    byId("window").addEventListener("submit", (event) => event.preventDefault());
    byId("auto").addEventListener("click", () => {
      this.chosen = false;
      this.set(...this.automatic);
    });
    byId("low").addEventListener("input", () => this.keepApart("low"));
    byId("high").addEventListener("input", () => this.keepApart("high"));
  }

  // `slice` gives the address of a typical slice, drawn with a window.
  async measure(slice) {
    let [low, high] = FIRST;
    let counts = [];
    for (let look = 0; look < LOOKS; look += 1) {
      counts = histogram(await load(slice({ low, high })));
      if (look + 1 === LOOKS) break;
      const step = (high - low) / 255;
      const first = counts.findIndex((count) => count > 0);
      const last = counts.findLastIndex((count) => count > 0);
      [low, high] = [Math.max(low, low + (first - 1) * step), Math.min(high, low + (last + 1) * step)];
    }
    const at = (share) => low + (percentile(counts, share) / 255) * (high - low);
    this.automatic = [at(0.005), at(0.998)];
    this.gap = (high - low) / STEPS;
    const { low: black, high: white } = this.window;
    for (const id of ["low", "high"]) Object.assign(byId(id), { min: low, max: high, step: this.gap });
    this.set(...(this.chosen ? [black, white] : this.automatic));
  }

  set(low, high) {
    byId("low").value = low;
    byId("high").value = Math.max(high, low + this.gap);
    this.tell();
  }

  // Black stays below white: the one that is moved pushes the other.
  keepApart(moved) {
    this.chosen = true;
    const low = byId("low");
    const high = byId("high");
    if (high.valueAsNumber - low.valueAsNumber < this.gap) {
      if (moved === "low") high.value = low.valueAsNumber + this.gap;
      else low.value = high.valueAsNumber - this.gap;
      if (high.valueAsNumber <= low.valueAsNumber) low.value = high.valueAsNumber - this.gap;
      if (high.valueAsNumber <= low.valueAsNumber) high.value = low.valueAsNumber + this.gap;
    }
    this.tell();
  }

  tell() {
    for (const id of ["low", "high"]) {
      const text = `${number(byId(id).valueAsNumber)} /mm`;
      setText(byId(`${id}-text`), text);
      byId(id).setAttribute("aria-valuetext", text);
    }
    this.onChange();
  }

  get window() {
    return { low: byId("low").valueAsNumber, high: byId("high").valueAsNumber };
  }
}

function histogram(image) {
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth;
  canvas.height = image.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height).data;
  const counts = new Array(256).fill(0);
  for (let i = 0; i < pixels.length; i += 4) counts[pixels[i]] += 1;
  return counts;
}

function percentile(counts, share) {
  let left = share * counts.reduce((a, b) => a + b, 0);
  return Math.max(0, counts.findIndex((count) => (left -= count) <= 0));
}
