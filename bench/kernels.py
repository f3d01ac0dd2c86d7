"""How fast the kernels are, and what share of this machine's arithmetic they use.

    python bench/kernels.py [--quick] [--json FILE]

Times are the best of several calls, in ms: forward (`render`), backward (`render_vjp`, from a given dL/dimage)
and motion (`motion_normal`). Splats have a standard deviation of about one pixel of a 512 x 512 detector. The last
columns set them against plain torch with autograd, on as many threads: the projection of `splatcore.reference`, and
windows of pixels around the centres instead of whole images.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatcore import _native, reference
from splatcore.geometry import circular
from splatcore.splats import Splats

SIZE = 512  # pixels
LANES = {"avx512": 16, "avx2": 8, "plain": 4}  # floats in a register

# Floating-point operations of one visited lane, a multiply-add being two. Compares, selects, integer and address
# work are free here; so are the values that a whole column or row of a footprint shares.
#   value: 3 for the exponent (a sum, a multiply-add), 13 for 2^x (three for the remainder, five multiply-adds)
VALUE = 3 + 13
FORWARD = VALUE + 2  # image += amplitude e
BACKWARD = VALUE + 6  # g e, times dy; three sums, of which one multiplies
MOTION = VALUE + 2 + 12 * 6  # the value; for each direction a line in dy twice (2 + 2), and a multiply-add of the value
NORMAL = 13 + 2 * (78 + 13) + 10  # per detector pixel: root weights; products of the 13 images; the plain sums
# Of one splat, counted in csrc/math and kernels/stamp.hpp (cone beam; a root or a division is one).
#   offset and q 19, J 20, det J 10, axes 57, clearance 28, T 30, W and S^-1 57, amplitude 8; the stamp 36
PROJECT = 19 + 20 + 10 + 57 + 28 + 30 + 57 + 8
STAMP = 36
#   centre and density 10, dL/dT 36, per axis 43, quaternion 70, J and depth 43, mean and torque 24
REVERSE = 10 + 36 + 3 * 43 + 70 + 43 + 24
DERIVATIVE = 165  # of a direction: mean 19, J 39, dT 67, Y 20, coefficients 20


@dataclass(frozen=True)
class Row:
    splats: int
    threads: int
    forward_ms: float
    backward_ms: float
    motion_ms: float
    forward_gflop: float
    backward_gflop: float
    motion_gflop: float
    torch_forward_ms: float
    torch_backward_ms: float

    def share(self, what: str, peak: float) -> float:
        """Of `peak` multiply-adds a second."""
        gflop, ms = getattr(self, f"{what}_gflop"), getattr(self, f"{what}_ms")
        return float(gflop / (ms * 1e-3) / (2 * peak * 1e-9))


def best(run: Callable[[], Any], seconds: float) -> float:
    """The shortest of the calls that fit into the time, at least three. ms"""
    run()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 3 or time.perf_counter() < end:
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def scene(count: int) -> tuple[Splats, np.ndarray]:
    """Splats in a ball that fills most of the view, and a frame [4, 3]. 0.56 mm a pixel at the isocentre."""
    rng = np.random.default_rng(0)
    frames = circular("cone", np.array([30.0]), 500, 700, SIZE, SIZE, (400 / SIZE, 400 / SIZE))
    direction = rng.normal(size=(count, 3))
    radius = 110 * rng.uniform(size=(count, 1)) ** (1 / 3)
    means = radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    scales = 0.56 * np.exp(0.3 * rng.normal(size=(count, 3)))
    splats = Splats(
        means.astype(np.float32),
        scales.astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.uniform(0.001, 0.01, count).astype(np.float32),
    )
    return splats, frames.packed()[0]


def twin_arguments(splats: Splats, frame: np.ndarray) -> tuple[Any, ...]:
    tensors = [torch.tensor(a).double() for a in splats.arrays()]
    return *tensors, torch.zeros(6, dtype=torch.float64), torch.tensor(frame), True, SIZE, SIZE


def visited(splats: Splats, frame: np.ndarray, lanes: int) -> int:
    """Pixels that `walk` visits, counted as it goes: columns in steps of a register from the first column of the
    ellipse, and in each step the rows that the ellipse has anywhere in it."""
    total = 0
    for at in range(0, len(splats), 20_000):
        part = Splats(*(a[at : at + 20_000] for a in splats.arrays()))
        with torch.no_grad():
            foot = reference.footprints(*twin_arguments(part, frame))
            cc, cr, rr = foot.covariance[:, 0, 0], foot.covariance[:, 0, 1], foot.covariance[:, 1, 1]
            column, row = foot.center.unbind(1)
            wide, tall, high = 4 * cc.sqrt(), 4 * rr.sqrt(), 4 * (rr - cr**2 / cc).sqrt()
            slope = cr / cc
            first, last = (column - wide).clamp(min=0).ceil(), (column + wide).clamp(max=SIZE - 1).floor()
            top, bottom = (row - tall).clamp(min=0).ceil(), (row + tall).clamp(max=SIZE - 1).floor()
            while (first <= last).any():
                left = torch.maximum(first - column, -wide)
                right = torch.minimum(first + lanes - 1 - column, wide)
                ends = torch.stack([slope * left, slope * right])
                low = torch.maximum(row + ends.amin(0) - high, top).ceil()
                up = torch.minimum(row + ends.amax(0) + high, bottom).floor()
                total += lanes * int(torch.where(first <= last, (up - low + 1).clamp(min=0), 0).sum())
                first = first + lanes
    return total


def torch_render(splats: tuple[Tensor, ...], frame: Tensor, order: Tensor) -> Tensor:
    """The twin as one would write it for speed: a window around each centre, added into the image. The splats come
    sorted by size, 2000 at a time, so that a window fits all of its chunk. float32 once projected. [SIZE, SIZE]"""
    image = torch.zeros(SIZE * SIZE)
    still = torch.zeros(6, dtype=torch.float64)
    for chunk in torch.split(order, 2000):
        means, scales, quats, density = (t[chunk] for t in splats)
        foot = reference.footprints(means, scales, quats, density, still, frame, True, SIZE, SIZE)
        inverse, amplitude = torch.linalg.inv(foot.covariance).float(), foot.amplitude.float()
        reach = int(4 * foot.covariance.detach().diagonal(dim1=1, dim2=2).sqrt().max()) + 1
        corner = foot.center.detach().round() - reach
        step = torch.arange(2 * reach + 1)
        pixel = corner[:, None, :].long() + step[None, :, None]  # [n, window, 2]
        dx = (pixel - foot.center[:, None, :]).float()
        x, y = dx[:, None, :, 0], dx[:, :, None, 1]
        m = inverse[:, 0, 0, None, None] * x * x + inverse[:, 1, 1, None, None] * y * y
        m = m + 2 * inverse[:, 0, 1, None, None] * x * y  # [n, window, window]
        inside = (pixel >= 0) & (pixel < SIZE)
        shown = (m < reference.CUTOFF) & inside[:, None, :, 0] & inside[:, :, None, 1]
        value = torch.where(shown, amplitude[:, None, None] * torch.exp(-m / 2), 0.0)
        at = pixel[:, :, None, 1] * SIZE + pixel[:, None, :, 0]
        image = image.index_add(0, at.clamp(0, SIZE * SIZE - 1).flatten(), value.flatten())
    return image.reshape(SIZE, SIZE)


def torch_ms(splats: Splats, frame: np.ndarray, threads: int, image: np.ndarray) -> tuple[float, float]:
    """Plain torch forward, and backward by autograd. Its image must be the core's, but for flips at the cut-off."""
    torch.set_num_threads(threads)
    leaves = tuple(torch.tensor(a).double().requires_grad_() for a in splats.arrays())
    order = torch.tensor(np.argsort(splats.scales.max(axis=1)))
    start = time.perf_counter()
    drawn = torch_render(leaves, torch.tensor(frame), order)
    middle = time.perf_counter()
    torch.autograd.grad(drawn.sum(), leaves)
    end = time.perf_counter()
    assert np.abs(drawn.detach().numpy() - image).max() < 1e-3 * image.max()
    return 1e3 * (middle - start), 1e3 * (end - middle)


def measure(count: int, threads: int, lanes: int, seconds: float) -> Row:
    splats, frame = scene(count)
    renderer = _native.Renderer32(SIZE, SIZE, threads)
    image, target = np.empty((SIZE, SIZE), np.float32), np.zeros((SIZE, SIZE), np.float32)
    out, motion = splats.zeros_like(), np.empty(6)
    hessian, gradient = np.empty((12, 12)), np.empty(12)
    s = splats.arrays()
    forward = best(lambda: renderer.render(frame, True, *s, image), seconds)
    backward = best(lambda: renderer.render_vjp(frame, True, *s, image, *out.arrays(), motion), seconds)
    normal = best(lambda: renderer.motion_normal(frame, True, *s, target, None, 1.0, hessian, gradient), seconds)
    pixels, plain = visited(splats, frame, lanes), torch_ms(splats, frame, threads, image)
    return Row(
        count, threads, forward, backward, normal,
        (pixels * FORWARD + count * (PROJECT + STAMP)) * 1e-9,
        (pixels * BACKWARD + count * (2 * PROJECT + STAMP + REVERSE)) * 1e-9,
        (pixels * MOTION + SIZE**2 * NORMAL + count * (PROJECT + STAMP + 12 * DERIVATIVE)) * 1e-9,
        *plain,
    )  # fmt: skip


def peak(threads: int) -> float:
    """Multiply-adds a second on registers, the best of ten runs."""
    rounds, rates = 1_000_000, []
    for _ in range(10):
        start = time.perf_counter()
        rates.append(_native.peak_fma(rounds, threads) / (time.perf_counter() - start))
    return max(rates)


def table(rows: list[Row], peaks: dict[int, float]) -> str:
    lines = [
        "| splats | threads | forward ms | backward ms | motion ms | share of peak f / b / m "
        "| torch forward ms | torch backward ms | times faster f / b |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for r in rows:
        shares = " / ".join(f"{100 * r.share(k, peaks[r.threads]):.0f} %" for k in ("forward", "backward", "motion"))
        times = f"{r.torch_forward_ms / r.forward_ms:,.0f} / {r.torch_backward_ms / r.backward_ms:,.0f}"
        lines.append(
            f"| {r.splats:,} | {r.threads} | {r.forward_ms:.2f} | {r.backward_ms:.2f} | {r.motion_ms:.2f} | {shares} "
            f"| {r.torch_forward_ms:,.0f} | {r.torch_backward_ms:,.0f} | {times} |"
        )
    lines.append("")
    lines += [f"Peak on {n} threads: {p * 1e-9:.1f} G multiply-adds/s." for n, p in peaks.items()]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="Time the kernels.")
    parser.add_argument("--quick", action="store_true", help="20,000 splats only, fewer repeats")
    parser.add_argument("--json", type=Path, help="write the numbers here as well")
    args = parser.parse_args()
    isa = _native.choose_isa(None)
    threads = [n for n in (1, 2) if n <= (os.cpu_count() or 1)]
    counts, seconds = ([20_000], 0.3) if args.quick else ([20_000, 50_000, 200_000], 2.0)
    peaks = {n: peak(n) for n in threads}
    rows = [measure(count, n, LANES[isa], seconds) for count in counts for n in threads]
    peaks = {n: max(peaks[n], peak(n)) for n in threads}
    print(f"{isa}, {SIZE} x {SIZE} px, load {os.getloadavg()[0]:.1f}\n")
    print(table(rows, peaks))
    if args.json:
        facts = {"isa": isa, "size": SIZE, "machine": platform.machine(), "load": os.getloadavg()[0]}
        facts |= {"peak_fma_per_s": peaks, "rows": [asdict(row) for row in rows]}
        args.json.write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
