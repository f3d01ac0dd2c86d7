"""The same bits for any number of threads, and every time."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest

from splatcore import _native

from . import scenes

ROWS, COLS, COUNT = 90, 101, 3001  # several bands of rows and chunks of splats, none of them full
RUNS = list(product((1, 2, 3), range(2)))
DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])
GRID = np.array([[6.0, 5.5, 7.0], [4.0, -3.0, 2.0]])
SHAPE = (29, 23, 37)


def splats(dtype: type) -> list[np.ndarray]:
    return [a.astype(dtype) for a in scenes.cloud(COUNT, sigma=4.0, spread=110.0).numpy()]


def view() -> np.ndarray:
    packed = scenes.frames("cone", rows=ROWS, cols=COLS).packed()[1]
    packed[2:] *= 0.5
    return packed


def same_bits(run: Callable[[int], list[Any]]) -> None:
    """`run(threads)` twice for each number of threads."""
    first = [np.asarray(x).tobytes() for x in run(1)]
    assert any(any(bits) for bits in first)
    for threads, _ in RUNS:
        assert [np.asarray(x).tobytes() for x in run(threads)] == first, threads


@DTYPES
def test_renderer(isa: str, dtype: type) -> None:
    """Everything a renderer does, in this order and the other: its scratch memory carries nothing over."""
    s, frame = splats(dtype), view()
    rng = np.random.default_rng(0)
    y = rng.normal(size=(ROWS, COLS)).astype(dtype)
    mask = rng.uniform(size=(ROWS, COLS)).astype(dtype)
    make = _native.Renderer32 if dtype is np.float32 else _native.Renderer64

    def run(threads: int, turned: bool = False) -> list[Any]:
        renderer, out = make(ROWS, COLS, threads), {}
        gradients = {name: [np.full_like(a, np.nan) for a in s] for name in ("vjp", "loss")}
        image, motion = np.empty_like(y), np.empty(6)
        hessian, gradient = np.empty((12, 12)), np.empty(12)
        steps: list[tuple[str, Callable[[], Any]]] = [
            ("render", lambda: renderer.render(frame, True, *s, image)),
            ("vjp", lambda: renderer.render_vjp(frame, True, *s, y, *gradients["vjp"], motion)),
            ("loss", lambda: renderer.loss_vjp(frame, True, *s, y, mask, 1e-3, 0.3, 1.0, *gradients["loss"])),
            ("normal", lambda: renderer.motion_normal(frame, True, *s, y, mask, 1.0, hessian, gradient)),
        ]
        for name, step in steps[::-1] if turned else steps:
            out[name] = step()
        return [image, *gradients["vjp"], motion, *gradients["loss"], out["loss"], hessian, gradient, out["normal"]]

    same_bits(run)
    same_bits(lambda threads: run(threads, turned=threads > 1))


@DTYPES
def test_voxelize(isa: str, dtype: type) -> None:
    s = splats(dtype)
    y = np.random.default_rng(0).normal(size=SHAPE).astype(dtype)

    def run(threads: int) -> list[Any]:
        volume, gradients = np.empty_like(y), [np.empty_like(a) for a in s]
        _native.voxelize(GRID, *s, volume, threads)
        _native.voxelize_vjp(GRID, *s, y, *gradients, threads)
        return [volume, *gradients]

    same_bits(run)


@DTYPES
def test_rays(isa: str, dtype: type) -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=SHAPE).astype(dtype), rng.normal(size=(ROWS, COLS)).astype(dtype)

    def run(threads: int) -> list[Any]:
        image, added, drawn = np.empty_like(y), np.ones_like(x), np.ones_like(x)
        _native.project_volume(view(), True, GRID, x, image, threads)
        _native.project_volume_adjoint(view(), True, GRID, y, added, threads)
        _native.backproject(view(), True, GRID, y, 0.1, drawn, threads)
        return [image, added, drawn]

    same_bits(run)


@DTYPES
def test_adam(isa: str, dtype: type) -> None:
    rng = np.random.default_rng(0)
    means, scales, quats, density = splats(dtype)
    slopes = [rng.normal(size=a.shape).astype(dtype) for a in (means, scales, quats, density)]

    def run(threads: int) -> list[Any]:
        state = [a.copy() for a in (means, np.log(scales), quats, np.log(np.expm1(density)), scales, density)]
        first, second = np.zeros(11 * COUNT, dtype), np.zeros(11 * COUNT, dtype)
        for step in range(1, 5):
            _native.adam(*state, first, second, *slopes, 0.1, 0.01, 0.01, 0.02, 1.0, 20.0, 1.0, step, threads)
        return [*state, first, second]

    same_bits(run)


def test_adam_is_its_definition(isa: str) -> None:
    """Kingma & Ba's algorithm 1 on the raw parameters, written out."""
    n = 50
    means, scales, quats, density = (a[:n].copy() for a in splats(np.float64))
    unit, rates, low, high = 0.01, (0.1, 0.05, 0.02, 0.3), 2.0, 6.0
    raw = np.log(np.expm1(density / unit))
    state = [means.copy(), np.log(scales), quats.copy(), raw.copy(), scales.copy(), density.copy()]
    first, second = np.zeros(11 * n), np.zeros(11 * n)
    twin = [means.copy(), np.log(scales), quats.copy(), raw.copy()]
    m, v = ([np.zeros_like(a) for a in twin] for _ in range(2))
    rng = np.random.default_rng(1)
    for step in range(1, 8):
        slopes = [rng.normal(size=a.shape) for a in (means, scales, quats, density)]
        activated = [
            slopes[0], slopes[1] * np.exp(twin[1]), slopes[2], slopes[3] * unit / (1 + np.exp(-twin[3]))
        ]  # fmt: skip
        for k in range(4):
            m[k] = 0.9 * m[k] + 0.1 * activated[k]
            v[k] = 0.999 * v[k] + 0.001 * activated[k] ** 2
            twin[k] -= rates[k] * (m[k] / (1 - 0.9**step)) / (np.sqrt(v[k] / (1 - 0.999**step)) + 1e-15)
        twin[1] = np.clip(twin[1], np.log(low), np.log(high))
        _native.adam(*state, first, second, *slopes, *rates, low, high, unit, step, 2)
    for actual, expected in zip(state[:4], twin, strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-9)
    np.testing.assert_allclose(state[4], np.exp(twin[1]), rtol=1e-9)
    np.testing.assert_allclose(state[5], unit * np.log1p(np.exp(twin[3])), rtol=1e-9)
