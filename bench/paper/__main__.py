"""SplatCT beside the paper, R2-Gaussian, classical methods and RTK, on simulated scans of real objects.

    python -m bench.paper --quick                      ten minutes on two cores
    python -m bench.paper --data DIR --out results     everything; hours: R2-Gaussian and the paper take 30,000 steps
    python -m bench.paper --only headline,rtk --projector rtk --rtk-python RTKENV/bin/python

Head, chest, pelvis and catphan are in bench/paper/volumes; teapot, bonsai and engine, and sizes above 128, come from
--data. What is computed is kept in --work, by all that decides it and the engine's code; the same command goes on
where it was interrupted. Run it in the root of the source tree.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from bench.paper import plan, report
from bench.paper.cells import METHODS
from bench.paper.rtk.remote import RTK, RtkError
from bench.paper.run import Bench
from bench.paper.scenes import SCENES, find_volume
from splatcore.machine import threads_allowed

_QUICK_SCENES, _QUICK_EDGE, _QUICK_STEPS, _QUICK_VIEWS = ("head",), 64, 1500, 50
_QUICK_ONLY = "headline,right,rtk"


def main(argv: list[str] | None = None) -> int:
    args = _parse(argv)
    rtk = RTK(args.rtk_python)
    only = [name for name in args.only.split(",") if name]
    try:
        if args.projector in ("rtk", "both") or args.only == "rtk":
            rtk.require()
    except RtkError as error:
        print(error, file=sys.stderr)
        return 2
    bench = Bench(args.work, args.data, args.threads or threads_allowed(), rtk)
    scenes = tuple(args.scenes.split(",")) if args.scenes else _findable(args.edge, args.data)
    projectors = {"own": ("own",), "rtk": ("rtk",), "both": ("own", "rtk")}[args.projector]
    methods = tuple(name.strip() for name in args.methods.split(";")) if args.methods else None
    extent = plan.Extent(scenes, args.edge, projectors, args.seed, args.steps, methods, args.views)
    plans = {name: plan.PRESETS[name](extent) for name in only}
    total = len({cell.key for cells in plans.values() for cell in cells})
    print(f"{total} cells, {bench.threads} threads, scenes {', '.join(scenes)}, projector {args.projector}", flush=True)
    if not total:
        print("nothing to do: no cell has these scenes and methods", file=sys.stderr)
        return 2
    found = {name: bench.run(cells, lambda line: print(line, flush=True)) for name, cells in plans.items()}
    command = shlex.join(["python", "-m", "bench.paper", *(sys.argv[1:] if argv is None else argv)])
    for path in report.write(args.out, bench, extent, found, command):
        print(path)
    return 0


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m bench.paper", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    add = parser.add_argument
    add("--quick", action="store_true", help=f"{_QUICK_EDGE}^3, {_QUICK_VIEWS} views, {_QUICK_STEPS} steps of the "
        f"baselines, scenes {', '.join(_QUICK_SCENES)}, tables {_QUICK_ONLY}")  # fmt: skip
    add("--only", default=None, metavar="TABLES", help=f"of {', '.join(plan.PRESETS)}; r2 only where it is named")
    add("--data", type=Path, help="folder of NAME_128.npz, NAME_256.npz (key volume, uint8 [z, y, x])")
    add("--scenes", metavar="NAMES", help=f"of {', '.join(SCENES)}; default: all that are found")
    add("--methods", metavar="NAMES", help=f"separated by semicolons, of: {'; '.join(METHODS)}")
    add("--projector", choices=["own", "rtk", "both"], default="own", help="who makes the projections")
    add("--rtk-python", default=sys.executable, metavar="PATH", help="a Python that has itk-rtk")
    add("--edge", type=int, help="voxels a side; default 128")
    add("--views", type=int, help="default 75")
    add("--steps", type=int, help="Adam steps of R2-Gaussian and the paper's method; default 30,000")
    add("--seed", type=int, default=0)
    add("--threads", type=int)
    add("--work", type=Path, default=Path("bench-work"), help="where scans and finished cells are kept")
    add("--out", type=Path, default=Path("bench-results"), help="where results.md and results.json go")
    args = parser.parse_args(argv)
    if args.quick:
        args.scenes = args.scenes or ",".join(_QUICK_SCENES)
    args.only = args.only or (_QUICK_ONLY if args.quick else ",".join(plan.EVERYTHING))
    args.edge = args.edge or (_QUICK_EDGE if args.quick else 128)
    args.views = args.views or (_QUICK_VIEWS if args.quick else 75)
    args.steps = args.steps or (_QUICK_STEPS if args.quick else None)
    for what, given, known in (
        ("--only", args.only.split(","), plan.PRESETS),
        ("--scenes", (args.scenes or "").split(",") if args.scenes else [], SCENES),
        ("--methods", [m.strip() for m in args.methods.split(";")] if args.methods else [], METHODS),
    ):
        for name in given:
            if name not in known:
                parser.error(f"{what}: got {name!r}, expected of {', '.join(known)}")
    return args


def _findable(edge: int, data: Path | None) -> tuple[str, ...]:
    """The scenes whose volume is there."""
    names = []
    for name, scene in SCENES.items():
        try:
            find_volume(scene, edge, data)
        except FileNotFoundError as error:
            print(f"left out: {error}")
            continue
        names.append(name)
    return tuple(names)


if __name__ == "__main__":
    sys.exit(main())
