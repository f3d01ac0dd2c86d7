"""How fast the kernels are, and what share of this machine's arithmetic they use.

    python bench/kernels.py [--quick] [--growth] [--core FILE] [--json FILE]

Times are the best of several calls, in ms, of the processor on one thread (so that a busy machine shows less) and of
the clock on two: forward (`render`), reverse (`render_vjp`, from a given dL/dimage) and
pose equations (`motion_normal`), on scenes of 512 x 512 pixels with splats of a pixel, and on two as a scan's finest
level has them. The last columns set them against plain torch with autograd, on as many threads: the projection of
`splatcore.reference`, and windows of pixels around the centres instead of whole images.

Shares of peak are of multiply-adds, and count pixels within the cutoff ellipse alone: never a lane that idles, a
pixel that is visited in vain, or a splat that is projected once for each band. "done" counts the arithmetic that is
done for them, "formula" that of evaluating the formula at each pixel: one exponential and, for the poses, twelve
quadratics. The kernels do less than that, so "formula" says what a machine at full use would need to keep up.

--growth fits the exponents of time in splats, pixels and views. --core times another build of the core: give the
path of its `_native*.so`, and run the two in turn.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatcore import reference
from splatcore.geometry import circular
from splatcore.splats import Splats

KERNELS = ("forward", "reverse", "poses")

# Floating-point operations, a multiply-add being two; compares, selects, integer and address work are free.
# At a pixel within the ellipse:
#   value: two products (kernels/stamp.hpp). Formula: 3 for the exponent, 15 for 2^x (3 for the remainder, 6 twice)
#   forward: image += amplitude e. Reverse: g e, times dy; three sums, of which one multiplies
#   poses: amplitude e, image +=; for each direction a quadratic in dx, and a multiply-add of the value (formula: the
#   same, by lines in dy)
DONE, FORMULA = 2, 18
PIXEL = {"forward": 2, "reverse": 6, "poses": 3 + 12 * 6}
# In a column of the ellipse, where products begin: two exponents and two exponentials; the reverse's sums times dx
COLUMN = {"forward": 46, "reverse": 46 + 8, "poses": 46}
# In a row of the ellipse: the quadratics' coefficients in dx
ROW = {"forward": 0, "reverse": 0, "poses": 12 * 6}
# Of one splat, counted in csrc/math and kernels/stamp.hpp (cone beam; a root or a division is one):
#   offset and q 19, J 20, det J 10, axes 57, clearance 28, T 30, W and S^-1 57, amplitude 8; the stamp 60
PROJECT = 19 + 20 + 10 + 57 + 28 + 30 + 57 + 8 + 60
#   centre and density 10, dL/dT 36, per axis 43, quaternion 70, J and depth 43, mean and torque 24
REVERSE = 10 + 36 + 3 * 43 + 70 + 43 + 24
#   three shifts of 33 and 17 before, four cross products and two M w of 66, three turns of 13, six sums of them 114
DERIVATIVES = 3 * 33 + 17 + 66 + 3 * 13 + 114
SPLAT = {"forward": PROJECT, "reverse": PROJECT + REVERSE, "poses": PROJECT + DERIVATIVES}
# Of a detector pixel: residual, weights and plain sums 10; products of 13 images 13 + 2 * 91
DETECTOR = {"forward": 0, "reverse": 0, "poses": 10 + 13 + 2 * 91}


def core(path: Path | None) -> ModuleType:
    """The installed core, or another build of it. Only one can be in a process."""
    if path and "splatcore._native" not in sys.modules:
        spec = importlib.util.spec_from_file_location("splatcore._native", path)
        if spec is None or spec.loader is None:
            raise SystemExit(f"{path} is not a Python module")
        sys.modules["splatcore._native"] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return importlib.import_module("splatcore._native")


@dataclass(frozen=True)
class Scene:
    """Splats in a ball that fills most of the view of a square detector."""

    splats: Splats
    frame: np.ndarray  # [4, 3]
    size: int  # pixels

    @classmethod
    def of(cls, count: int, size: int, sigma_px: float) -> Scene:
        """The field is 286 mm wide at the isocentre."""
        rng = np.random.default_rng(0)
        frames = circular("cone", np.array([30.0]), 500, 700, size, size, (400 / size, 400 / size))
        direction = rng.normal(size=(count, 3))
        radius = 110 * rng.uniform(size=(count, 1)) ** (1 / 3)
        means = radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        scales = sigma_px * 286 / size * np.exp(0.3 * rng.normal(size=(count, 3)))
        splats = Splats(
            means.astype(np.float32),
            scales.astype(np.float32),
            rng.normal(size=(count, 4)).astype(np.float32),
            rng.uniform(0.001, 0.01, count).astype(np.float32),
        )
        return cls(splats, frames.packed()[0], size)

    def extent(self) -> tuple[int, int, int]:
        """Pixels, columns and rows within the cutoff ellipses and the image, over all splats."""
        pixels = lines = columns = 0
        still = torch.zeros(6, dtype=torch.float64)
        for at in range(0, len(self.splats), 20_000):
            part = [torch.tensor(a[at : at + 20_000]).double() for a in self.splats.arrays()]
            foot = reference.footprints(*part, still, torch.tensor(self.frame), True, self.size, self.size)
            cc, cr, rr = foot.covariance[:, 0, 0], foot.covariance[:, 0, 1], foot.covariance[:, 1, 1]
            column, row = foot.center.unbind(1)
            wide, tall = 4 * cc.sqrt(), 4 * rr.sqrt()
            columns += int(self._whole(column - wide, column + wide).sum())
            y = (row - tall).clamp(min=0).ceil()
            while (inside := (y <= (row + tall).clamp(max=self.size - 1))).any():
                dy = y - row
                half = ((16 - dy**2 / rr).clamp(min=0) * (cc - cr**2 / rr)).sqrt()
                middle = column + cr / rr * dy
                pixels += int(torch.where(inside, self._whole(middle - half, middle + half), 0).sum())
                lines += int(inside.sum())
                y = y + 1
        return pixels, columns, lines

    def _whole(self, low: Tensor, high: Tensor) -> Tensor:
        """How many pixels from low to high lie in the image."""
        return (high.clamp(max=self.size - 1).floor() - low.clamp(min=0).ceil() + 1).clamp(min=0)


@dataclass(frozen=True)
class Row:
    splats: int
    size: int
    sigma_px: float
    threads: int
    ms: dict[str, float]
    done_gflop: dict[str, float]
    formula_gflop: dict[str, float]
    torch_ms: dict[str, float]

    def share(self, gflop: dict[str, float], kernel: str, peak: float) -> float:
        """Of `peak` multiply-adds a second."""
        return gflop[kernel] / (self.ms[kernel] * 1e-3) / (2 * peak * 1e-9)


def best(run: Callable[[], Any], seconds: float, threads: int) -> float:
    """The shortest of the calls that fit into the time, at least three. ms"""
    clock = time.thread_time if threads == 1 else time.perf_counter
    run()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 3 or time.perf_counter() < end:
        start = clock()
        run()
        times.append(clock() - start)
    return 1e3 * min(times)


def torch_render(splats: tuple[Tensor, ...], frame: Tensor, order: Tensor, size: int) -> Tensor:
    """The twin as one would write it for speed: a window around each centre, added into the image. The splats come
    sorted by size, 2000 at a time, so that a window fits all of its chunk. float32 once projected. [size, size]"""
    image = torch.zeros(size * size)
    still = torch.zeros(6, dtype=torch.float64)
    for chunk in torch.split(order, 2000):
        means, scales, quats, density = (t[chunk] for t in splats)
        foot = reference.footprints(means, scales, quats, density, still, frame, True, size, size)
        inverse, amplitude = torch.linalg.inv(foot.covariance).float(), foot.amplitude.float()
        reach = int(4 * foot.covariance.detach().diagonal(dim1=1, dim2=2).sqrt().max()) + 1
        corner = foot.center.detach().round() - reach
        step = torch.arange(2 * reach + 1)
        pixel = corner[:, None, :].long() + step[None, :, None]  # [n, window, 2]
        dx = (pixel - foot.center[:, None, :]).float()
        x, y = dx[:, None, :, 0], dx[:, :, None, 1]
        m = inverse[:, 0, 0, None, None] * x * x + inverse[:, 1, 1, None, None] * y * y
        m = m + 2 * inverse[:, 0, 1, None, None] * x * y  # [n, window, window]
        inside = (pixel >= 0) & (pixel < size)
        shown = (m < reference.CUTOFF) & inside[:, None, :, 0] & inside[:, :, None, 1]
        value = torch.where(shown, amplitude[:, None, None] * torch.exp(-m / 2), 0.0)
        at = pixel[:, :, None, 1] * size + pixel[:, None, :, 0]
        image = image.index_add(0, at.clamp(0, size * size - 1).flatten(), value.flatten())
    return image.reshape(size, size)


def torch_ms(scene: Scene, threads: int, image: np.ndarray) -> tuple[float, float]:
    """Plain torch forward, and backward by autograd. Its image must be the core's, but for flips at the cut-off."""
    torch.set_num_threads(threads)
    leaves = tuple(torch.tensor(a).double().requires_grad_() for a in scene.splats.arrays())
    order = torch.tensor(np.argsort(scene.splats.scales.max(axis=1)))
    start = time.perf_counter()
    drawn = torch_render(leaves, torch.tensor(scene.frame), order, scene.size)
    middle = time.perf_counter()
    torch.autograd.grad(drawn.sum(), leaves)
    end = time.perf_counter()
    assert np.abs(drawn.detach().numpy() - image).max() < 1e-3 * image.max()
    return 1e3 * (middle - start), 1e3 * (end - middle)


def timed(native: ModuleType, scene: Scene, threads: int, seconds: float) -> tuple[dict[str, float], np.ndarray]:
    """ms by kernel, and the image."""
    size = scene.size
    renderer = native.Renderer32(size, size, threads)
    image, target = np.empty((size, size), np.float32), np.zeros((size, size), np.float32)
    out, motion = scene.splats.zeros_like().arrays(), np.empty(6)
    hessian, gradient = np.empty((12, 12)), np.empty(12)
    at = (scene.frame, True, *scene.splats.arrays())
    runs: list[Callable[[], Any]] = [
        lambda: renderer.render(*at, image),
        lambda: renderer.render_vjp(*at, image, *out, motion),
        lambda: renderer.motion_normal(*at, target, None, 1.0, hessian, gradient),
    ]
    return {name: best(run, seconds, threads) for name, run in zip(KERNELS, runs, strict=True)}, image


def measure(
    native: ModuleType, count: int, size: int, sigma_px: float, threads: int, seconds: float, against: bool
) -> Row:
    scene = Scene.of(count, size, sigma_px)
    ms, image = timed(native, scene, threads, seconds)
    pixels, columns, lines = scene.extent()

    def gflop(kernel: str, value: int, begin: int) -> float:
        in_footprints = pixels * (value + PIXEL[kernel]) + columns * begin + lines * ROW[kernel]
        return 1e-9 * (in_footprints + count * SPLAT[kernel] + size**2 * DETECTOR[kernel])

    done = {kernel: gflop(kernel, DONE, COLUMN[kernel]) for kernel in KERNELS}
    formula = {kernel: gflop(kernel, FORMULA, 0) for kernel in KERNELS}
    torch_times = torch_ms(scene, threads, image) if against else ()
    return Row(count, size, sigma_px, threads, ms, done, formula, dict(zip(KERNELS, torch_times, strict=False)))


def peak(native: ModuleType, threads: int) -> float:
    """Multiply-adds a second on registers, the best of ten runs."""
    clock = time.thread_time if threads == 1 else time.perf_counter
    rounds, rates = 1_000_000, []
    for _ in range(10):
        start = clock()
        rates.append(native.peak_fma(rounds, threads) / (clock() - start))
    return max(rates)


def table(rows: list[Row], peaks: dict[int, float]) -> str:
    lines = [
        "| splats | pixels | sigma px | threads | forward ms | reverse ms | poses ms | share of peak, done f / r / p "
        "| share of peak, formula | torch forward, reverse ms | times faster |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for r in rows:
        shares = [
            " / ".join(f"{100 * r.share(gflop, k, peaks[r.threads]):.0f}" for k in KERNELS) + " %"
            for gflop in (r.done_gflop, r.formula_gflop)
        ]
        ms = " | ".join(f"{r.ms[k]:.2f}" for k in KERNELS)
        other = ", ".join(f"{v:,.0f}" for v in r.torch_ms.values())
        times = ", ".join(f"{v / r.ms[k]:,.0f}" for k, v in r.torch_ms.items())
        what = f"{r.splats:,} | {r.size}² | {r.sigma_px} | {r.threads}"
        lines.append(f"| {what} | {ms} | {' | '.join(shares)} | {other} | {times} |")
    lines.append("")
    lines += [f"Peak on {n} threads: {p * 1e-9:.1f} G multiply-adds/s." for n, p in peaks.items()]
    return "\n".join(lines)


def exponent(sizes: list[float], times: list[float]) -> float:
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def growth(native: ModuleType, threads: int, seconds: float) -> str:
    """Time against splats, against pixels of the same field of view (footprints grow with them), against views."""
    lines = ["| grows | from | to | forward | reverse | poses |", "|---|---:|---:|---:|---:|---:|"]
    counts, sizes = [12_500, 25_000, 50_000, 100_000, 200_000], [128, 256, 512, 1024]
    by_count = [timed(native, Scene.of(n, 512, 1.0), threads, seconds)[0] for n in counts]
    by_size = [timed(native, Scene.of(30_000, n, n / 512), threads, seconds)[0] for n in sizes]
    scene = Scene.of(30_000, 256, 0.6)
    frames = circular("cone", np.arange(64) * 360 / 64, 500, 700, 256, 256, (400 / 256, 400 / 256)).packed()
    views = [8, 16, 32, 64]

    def sweep(n: int) -> dict[str, float]:
        each = [timed(native, Scene(scene.splats, frame, 256), threads, seconds / 64)[0] for frame in frames[:n]]
        return {k: sum(ms[k] for ms in each) for k in KERNELS}

    for what, steps, times in (
        ("splats", counts, by_count),
        ("pixels", [n * n for n in sizes], by_size),
        ("views", views, [sweep(n) for n in views]),
    ):
        fits = " | ".join(f"{exponent([float(n) for n in steps], [ms[k] for ms in times]):.2f}" for k in KERNELS)
        lines.append(f"| {what} | {steps[0]:,} | {steps[-1]:,} | {fits} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="Time the kernels.")
    parser.add_argument("--quick", action="store_true", help="20,000 splats only, fewer repeats")
    parser.add_argument("--growth", action="store_true", help="exponents of time in splats, pixels and views instead")
    parser.add_argument("--core", type=Path, metavar="FILE", help="time this build of the core")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers here as well")
    args = parser.parse_args()
    native = core(args.core)
    isa = native.choose_isa(None)
    if args.growth:
        print(f"{isa}, 1 thread, load {os.getloadavg()[0]:.1f}: exponents of time\n")
        print(growth(native, 1, 0.2 if args.quick else 1.0))
        return
    threads = [n for n in (1, 2) if n <= (os.cpu_count() or 1)]
    scenes = [(20_000, 512, 1.0), (50_000, 512, 1.0), (200_000, 512, 1.0), (30_000, 256, 0.6), (80_000, 512, 0.7)]
    seconds = 0.3 if args.quick else 2.0
    peaks = {n: peak(native, n) for n in threads}
    rows = [
        measure(native, *scene, n, seconds, against=args.core is None)
        for scene in (scenes[:1] if args.quick else scenes)
        for n in threads
    ]
    peaks = {n: max(peaks[n], peak(native, n)) for n in threads}
    print(f"{isa}, load {os.getloadavg()[0]:.1f}\n")
    print(table(rows, peaks))
    if args.json:
        facts = {"isa": isa, "machine": platform.machine(), "load": os.getloadavg()[0]}
        facts |= {"peak_fma_per_s": peaks, "rows": [asdict(row) for row in rows]}
        args.json.write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
