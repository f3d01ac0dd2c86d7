"""A scan with everything wrong at once, with its truth, by a simulator that shares no formula with the engine.

    python bench/hardscan.py OUT [--edge 96] [--views 75] [--detector 192] [--seed 0]

Nothing is voxelised, splatted or linearised on the way to the images. The object is a set of solids (ellipsoids,
boxes, cylinders, in any orientation), one inside another; every ray's length in each is the difference of two roots,
in double precision. Rays go from several points of a focal spot to four points of every pixel. Attenuation is that
of PMMA, aluminium and water at five energies (NIST XCOM), behind a tungsten-like spectrum, so that beams harden. Then
come scatter, gain and lag of the detector, quantum and electronic noise, dead, hot and missing pixels, a drifting
tube; and a scanner whose axis wobbles and drifts, whose detector is rolled and off its middle, whose views jitter.
The truth volume is the attenuation at the energy that the detector sees most of.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]

KEV = (30, 45, 60, 80, 100)
SPECTRUM = np.array([0.16, 0.27, 0.29, 0.18, 0.10])  # of what the detector absorbs, in air
# 1/mm at those energies; NIST XCOM mass attenuation times density.
MATERIALS = {
    "air": np.zeros(5),
    "water": np.array([0.0376, 0.0246, 0.0206, 0.0184, 0.0171]),
    "pmma": np.array([0.0361, 0.0261, 0.0229, 0.0208, 0.0195]),
    "aluminium": np.array([0.3046, 0.1220, 0.0750, 0.0545, 0.0460]),
}
EFFECTIVE = 2  # index of the energy at which truth is told
UNIT = 0.03  # 1/mm that counts as 1 in scores

DSO, DSD, DETECTOR = 300.0, 500.0, 130.0  # mm; the detector's edge
WIDTH = 64.0  # mm, of the volume
SPOT = 0.4  # mm, full width of the focal spot
PHOTONS = 3e4  # in air, per pixel and view
SCATTER_SHARE, SCATTER_WIDTH = 0.06, 0.12  # of the primary's scattering signal; of the detector's edge
LAG = 0.03  # of a frame is read with the next
DARK, ELECTRONS = 110.0, 4.0  # counts


@dataclass(frozen=True)
class Solid:
    """A piece of one material inside a piece of another."""

    shape: str  # ellipsoid, box, cylinder (along its own z)
    center: tuple[float, float, float]  # mm
    half: tuple[float, float, float]  # mm, half axes; of a cylinder radius x, radius y, half height
    turn: tuple[float, float, float]  # Euler angles z, y, x, degrees
    inside: str  # its material
    around: str  # the material that it takes the place of

    def axes(self) -> Array:
        """Rows: its own axes in the world."""
        a, b, c = np.deg2rad(self.turn)
        z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        x = np.array([[1, 0, 0], [0, np.cos(c), -np.sin(c)], [0, np.sin(c), np.cos(c)]])
        return (z @ y @ x).T

    def own(self, points: Array) -> Array:
        """Points [..., 3] mm in its own axes, where it reaches from -1 to 1."""
        return (points - np.array(self.center)) @ (self.axes().T / np.array(self.half))

    def chord(self, start: Array, unit: Array) -> Array:
        """Length in mm of the lines start + t unit inside it. [..., 3], [..., 3] -> [...]"""
        p, d = self.own(start), unit @ (self.axes().T / np.array(self.half))
        enter, leave = np.full(p.shape[:-1], -np.inf), np.full(p.shape[:-1], np.inf)
        round_axes = {"ellipsoid": 3, "cylinder": 2, "box": 0}[self.shape]
        if round_axes:
            q, e = p[..., :round_axes], d[..., :round_axes]
            a, b, c = (e * e).sum(-1), (q * e).sum(-1), (q * q).sum(-1) - 1
            root = np.sqrt(np.maximum(b * b - a * c, 0))
            hit = b * b > a * c
            enter, leave = np.where(hit, (-b - root) / a, 0), np.where(hit, (-b + root) / a, 0)
        for axis in range(round_axes, 3):
            slope = np.where(np.abs(d[..., axis]) < 1e-12, 1e-12, d[..., axis])
            one, two = (-1 - p[..., axis]) / slope, (1 - p[..., axis]) / slope
            enter, leave = np.maximum(enter, np.minimum(one, two)), np.minimum(leave, np.maximum(one, two))
        return np.maximum(leave - enter, 0)

    def holds(self, points: Array) -> NDArray[np.bool_]:
        p = self.own(points)
        if self.shape == "ellipsoid":
            return (p * p).sum(-1) < 1
        if self.shape == "box":
            return np.abs(p).max(-1) < 1
        return ((p[..., :2] ** 2).sum(-1) < 1) & (np.abs(p[..., 2]) < 1)


# A moulded plastic housing with a water-filled hollow, metal parts, bores and cracks; none of it symmetrical.
OBJECT = (
    Solid("cylinder", (0.5, -0.4, 0), (24, 21, 24), (20, 4, -3), "pmma", "air"),
    Solid("ellipsoid", (-8, 5, 2), (9, 6.5, 12), (35, 15, 0), "water", "pmma"),
    Solid("ellipsoid", (-9, 5, 4), (2.2, 2.2, 3), (0, 0, 0), "air", "water"),
    Solid("box", (9, -4, 6), (4, 2.2, 5), (25, 10, 5), "aluminium", "pmma"),
    Solid("cylinder", (9, -4, 6), (1.1, 1.1, 4.7), (25, 10, 5), "air", "aluminium"),
    Solid("cylinder", (6, 9, -8), (2.5, 2.5, 7), (0, 35, 20), "aluminium", "pmma"),
    Solid("box", (-3, -11, -6), (6, 0.7, 6), (-15, 0, 30), "air", "pmma"),
    Solid("ellipsoid", (2, -8, 14), (3, 5, 2), (50, 0, 20), "air", "pmma"),
    Solid("box", (-6, -9, 12), (1.5, 3, 1.5), (40, 25, 0), "aluminium", "pmma"),
    *(
        Solid("ellipsoid", (x, y, z), (r, r, r), (0, 0, 0), "aluminium" if k % 2 else "air", "pmma")
        for k, (x, y, z, r) in enumerate(
            [(13, 6, -15, 1.2), (-13, -6, -14, 1.0), (3, 3, 18, 1.3), (-14, 3, -17, 1.4), (14, 3, 15, 0.9),
             (-2, -1, -18, 1.1), (12, -9, -9, 1.5), (-5, 14, 17, 1.0), (0, 15, -2, 1.2)]
        )
    ),
)  # fmt: skip


def scanner(views: int, detector: int, voxel: float, rng: np.random.Generator) -> tuple[Array, dict[str, Array]]:
    """(nominal angles in degrees, the true source, detector_center, u and v of every view, mm).

    Seen from the scanner the object moves: the axis wobbles once and twice a turn, creeps with the temperature, and
    every view jitters; the detector is rolled and off its middle."""
    angles = np.arange(views) * 360 / views
    a, time = np.deg2rad(angles), np.linspace(0, 1, views)
    wobble = np.stack([0.012 * np.cos(a + 1), 0.012 * np.sin(a + 1), 0.006 * np.sin(2 * a)], axis=1)
    shift = voxel * np.stack([1.5 * time, -1.0 * time + 0.7 * np.sin(a), 1.8 * time**2], axis=1)
    wobble, shift = wobble + rng.normal(0, 0.004, (views, 3)), shift + rng.normal(0, 0.25 * voxel, (views, 3))
    pitch, roll, offset = DETECTOR / detector, np.deg2rad(0.6), 1.7 * DETECTOR / detector
    frames: dict[str, list[Array]] = {key: [] for key in ("source", "detector_center", "u", "v")}
    for k in range(views):
        out, side = np.array([np.cos(a[k]), np.sin(a[k]), 0]), np.array([-np.sin(a[k]), np.cos(a[k]), 0])
        down = np.array([0, 0, -1.0])
        u, v = np.cos(roll) * side + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * side
        # The object turned by `wobble` and then shifted is the scanner shifted back and turned back.
        angle = float(np.linalg.norm(wobble[k]))
        axis = wobble[k] / angle
        x, y, z = axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        back = (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross).T
        frames["source"].append(back @ (DSO * out - shift[k]))
        frames["detector_center"].append(back @ (-(DSD - DSO) * out + offset * side - shift[k]))
        frames["u"].append(back @ (pitch * u))
        frames["v"].append(back @ (pitch * v))
    return angles, {key: np.array(value) for key, value in frames.items()}


def primary(frames: dict[str, Array], view: int, detector: int) -> tuple[Array, Array]:
    """(what comes through, what of it would scatter), shares of the open beam. [rows, cols] each"""
    source, center, u, v = (frames[key][view] for key in ("source", "detector_center", "u", "v"))
    place = np.arange(detector) - (detector - 1) / 2
    side = u / np.linalg.norm(u)
    through, scattering = np.zeros((detector, detector)), np.zeros((detector, detector))
    spots, corners = (
        ((-0.35, 0.2), (0.05, -0.35), (0.3, 0.25)),
        ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)),
    )
    for across, along in spots:
        spot = source + SPOT * (across * side + along * v / np.linalg.norm(v))
        for dr, dc in corners:
            pixel = center + (place[:, None, None] + dr) * v + (place[None, :, None] + dc) * u
            unit = pixel - spot
            unit /= np.linalg.norm(unit, axis=2, keepdims=True)
            start = np.broadcast_to(spot, unit.shape)
            depth = np.zeros((len(KEV), detector, detector))
            for solid in OBJECT:
                change = MATERIALS[solid.inside] - MATERIALS[solid.around]
                depth += change[:, None, None] * solid.chord(start, unit)
            left = np.exp(-depth)
            through += np.einsum("e,erc->rc", SPECTRUM, left)
            scattering += np.einsum("e,erc->rc", SPECTRUM, left * depth)
    samples = len(spots) * len(corners)
    return through / samples, scattering / samples


def truth(edge: int) -> NDArray[np.float32]:
    """Attenuation at the effective energy, means over 3^3 points of every voxel. [z, y, x] 1/mm"""
    voxel = WIDTH / edge
    fine = (np.arange(3 * edge) + 0.5) * voxel / 3 - WIDTH / 2
    volume = np.zeros((edge, edge, edge))
    for k in range(edge):
        z, y, x = np.meshgrid(fine[3 * k : 3 * k + 3], fine, fine, indexing="ij")
        points = np.stack([x, y, z], axis=-1)
        slab = np.zeros(x.shape)
        for solid in OBJECT:
            change = MATERIALS[solid.inside][EFFECTIVE] - MATERIALS[solid.around][EFFECTIVE]
            slab += change * solid.holds(points)
        volume[k] = slab.reshape(3, edge, 3, edge, 3).mean(axis=(0, 2, 4))
    return volume.astype(np.float32)


def make(out: Path, edge: int = 96, views: int = 75, detector: int = 192, seed: int = 0) -> None:
    """Write the scan folder."""
    rng = np.random.default_rng(seed)
    voxel = WIDTH / edge
    angles, frames = scanner(views, detector, voxel, rng)
    rows, cols = np.meshgrid(np.linspace(-1, 1, detector), np.linspace(-1, 1, detector), indexing="ij")
    gain = (1 - 0.15 * (rows**2 + cols**2)) * (1 + rng.normal(0, 0.02, rows.shape))  # heel, falloff, single pixels
    exposure = 1 - 0.06 * np.linspace(0, 1, views) + rng.normal(0, 0.01, views)
    bad = rng.random(gain.shape) < 0.002
    bad[detector // 3, detector // 2 :] = True  # half a row does not answer
    stuck = np.where(rng.random(gain.shape) < 0.5, 0.0, 60_000.0)

    def read(light: Array) -> NDArray[np.uint16]:
        counts = rng.poisson(PHOTONS * gain * light) + DARK + rng.normal(0, ELECTRONS, gain.shape)
        return np.clip(np.round(np.where(bad, stuck, counts)), 0, 65_535).astype(np.uint16)

    images, before = [], None
    for k in range(views):
        through, scattering = primary(frames, k, detector)
        wide = ndimage.gaussian_filter(scattering, SCATTER_WIDTH * detector, mode="constant")
        light = exposure[k] * (through + SCATTER_SHARE * wide)
        before = light if before is None else (1 - LAG) * light + LAG * before
        images.append(read(before))
    flat = np.stack([read(np.ones_like(gain)) for _ in range(20)])
    dark = np.stack([read(np.zeros_like(gain)) for _ in range(20)])

    out.mkdir(parents=True, exist_ok=True)
    volume = truth(edge)
    for name, pages in (("projections", np.stack(images)), ("flat", flat), ("dark", dark), ("truth", volume)):
        tifffile.imwrite(out / f"{name}.tif", pages, photometric="minisblack", compression="zlib", predictor=False)
    tifffile.imwrite(out / "bad.tif", bad.astype(np.uint8), photometric="minisblack")
    document = {
        "format": "splatct-scan/1",
        "name": "hardscan",
        "projections": {"files": ["projections.tif"], "kind": "counts", "flat": ["flat.tif"], "dark": ["dark.tif"]},
        "geometry": {
            "beam": "cone", "dso_mm": DSO, "dsd_mm": DSD, "angles_deg": angles.tolist(),
            "detector": {"rows": detector, "cols": detector, "pixel_mm": [DETECTOR / detector] * 2},
        },
        "volume": {"shape": [edge] * 3, "voxel_mm": [voxel] * 3},
        "bad_pixels": "bad.tif",
        "simulation": {
            "volume_file": "truth.tif", "attenuation_unit": UNIT, "exposure": exposure.tolist(),
            "frames": [{key: frames[key][k].tolist() for key in frames} for k in range(views)],
        },
    }  # fmt: skip
    (out / "scan.json").write_text(json.dumps(document), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="the scan folder to write")
    parser.add_argument("--edge", type=int, default=96, help="voxels along an edge of the truth")
    parser.add_argument("--views", type=int, default=75)
    parser.add_argument("--detector", type=int, default=192, help="rows = columns")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    make(args.out, args.edge, args.views, args.detector, args.seed)
    print(f"{args.out}: {args.views} views of {args.detector} x {args.detector}")


if __name__ == "__main__":
    main()
