"""Every knob of the engine: its name, unit, range and default. The one truth for the
command line, the HTTP API and the worker. Standard library only: the server imports it.
"""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from splatcore.errors import OptionsError

Calibrate = Literal["full", "static", "none"]
Quality = Literal["preview", "normal", "fine"]
Method = Literal["splatct", "r2", "paper"]
Rotation = Literal["auto", "given", "reversed"]
Switch = Literal["on", "off"]

_CHOICES = {"calibrate": Calibrate, "gate": Switch, "rotation": Rotation, "quality": Quality, "method": Method}


def _knob(default: Any, help: str, low: float | None = None, high: float | None = None) -> Any:
    return field(default=default, metadata={"help": help, "low": low, "high": high})


@dataclass(frozen=True)
class Options:
    """How to reconstruct one scan. Immutable; build from untrusted input with `from_dict`."""

    calibrate: Calibrate = _knob(
        "full", "full: every view's six degrees of freedom; static: the scanner's constant "
        "errors only; none: trust the nominal geometry"
    )  # fmt: skip
    gate: Switch = _knob(
        "on", "on: held-out views decide whether views move as freely as `calibrate` allows; off: they do"
    )  # fmt: skip
    rotation: Rotation = _knob(
        "auto", "turning sense. auto: the images decide, and whether rows and columns are exchanged; given: as "
        "the scan says; reversed: the other way"
    )  # fmt: skip
    flip_u: bool = _knob(False, "the images are stored mirrored left to right")
    flip_v: bool = _knob(False, "the images are stored upside down; nothing but the volume's handedness shows it")
    quality: Quality = _knob("normal", "preview stops at half resolution; fine runs longer")
    splats: int | None = _knob(None, "Gaussians at full resolution; default: chosen from the volume", 100, 5_000_000)
    method: Method = _knob(
        "splatct", "splatct: this engine's own; r2: R2-Gaussian, which trusts the geometry; paper: Choi et al. 2026, "
        "R2-Gaussian with an increment of every pose moved by Adam. Both to compare with: slower and less exact"
    )  # fmt: skip
    steps: int | None = _knob(None, "Adam steps of method r2 or paper; default 30000", 1, 10_000_000)
    dssim: float = _knob(0.0, "weight of the D-SSIM term of the loss beside L1", 0.0, 1.0)
    exposure: bool = _knob(True, "correct each view's line integrals for the drift of its exposure")
    seed: int = _knob(0, "seed of every random choice", 0, 2**31 - 1)
    threads: int | None = _knob(None, "CPU threads; default: all this process may use", 1, 1024)

    def __post_init__(self) -> None:
        for name, kind in _CHOICES.items():
            if getattr(self, name) not in get_args(kind):
                raise OptionsError(f"{name}: got {getattr(self, name)!r}, expected one of {', '.join(get_args(kind))}")
        for knob in dataclasses.fields(self):
            value, low, high = getattr(self, knob.name), knob.metadata["low"], knob.metadata["high"]
            if isinstance(knob.default, bool) and not isinstance(value, bool):
                raise OptionsError(f"{knob.name}: got {value!r}, expected true or false")
            if low is None or value is None:
                continue
            whole = knob.name != "dssim"
            if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
                raise OptionsError(f"{knob.name}: got {value!r}, expected a {'whole ' if whole else ''}number")
            if not low <= value <= high:  # false for nan
                shown = f"{value}" if abs(value) < 1e15 else "a number far beyond"  # nobody reads thousands of digits
                raise OptionsError(f"{knob.name}: got {shown}, expected {low} to {high}")

        if self.method == "splatct" and self.steps is not None:
            raise OptionsError(f"steps: got {self.steps} with method splatct, expected it with r2 or paper alone")

    @classmethod
    def from_dict(cls, given: dict[str, Any]) -> Options:
        """Options from parsed JSON. Raises OptionsError on an unknown name or a bad value."""
        known = [knob.name for knob in dataclasses.fields(cls)]
        unknown = sorted(set(given) - set(known))
        if unknown:
            raise OptionsError(f"unknown option {unknown[0]!r}; known: {', '.join(known)}")
        return cls(**given)

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def describe() -> list[dict[str, Any]]:
    """Each knob as a plain dict (name, default, choices, low, high, help), for forms and docs."""
    choices = {name: list(get_args(kind)) for name, kind in _CHOICES.items()}
    return [
        {"name": k.name, "default": k.default, "choices": choices.get(k.name), **k.metadata}
        for k in dataclasses.fields(Options)
    ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Every knob as a command-line option; left out means its default."""
    for knob in describe():
        if isinstance(knob["default"], bool):
            flag = f"--{knob['name'].replace('_', '-')}"
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, help=knob["help"])
            continue
        kind = str if knob["choices"] else (float if isinstance(knob["default"], float) else int)
        parser.add_argument(f"--{knob['name']}", type=kind, choices=knob["choices"], help=knob["help"])


def from_arguments(args: argparse.Namespace) -> Options:
    """The options that `add_arguments` put into a parsed command line."""
    given = {knob.name: getattr(args, knob.name) for knob in dataclasses.fields(Options)}
    return Options.from_dict({name: value for name, value in given.items() if value is not None})
