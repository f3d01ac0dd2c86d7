"""A run's state as JSON beside arrays, and back. No pickle: what comes back is plain values, arrays and dataclasses
that the caller names, never code.

    tree, arrays = freeze({"motions": motions, "step": 7})
    thaw(tree, arrays, [RigidMotions])
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]


def freeze(value: Any) -> tuple[Any, Arrays]:
    """What JSON can hold of a value, and its arrays by the names that stand in their places. Raises TypeError for what
    is neither a plain value, an array, a container of such or a dataclass of such."""
    arrays: Arrays = {}
    return _freeze(value, arrays), arrays


def thaw(tree: Any, arrays: Mapping[str, NDArray[Any]], kinds: Iterable[type]) -> Any:
    """The inverse of `freeze`; kinds: the dataclasses that may come back. Raises KeyError, TypeError or ValueError for
    what `freeze` did not make."""
    return _thaw(tree, arrays, {kind.__name__: kind for kind in kinds})


def _freeze(value: Any, arrays: Arrays) -> Any:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value)  # JSON's digits are exact for float64
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, list):
        return [_freeze(item, arrays) for item in value]
    if isinstance(value, tuple):
        return {"tuple": [_freeze(item, arrays) for item in value]}
    if isinstance(value, dict):
        return {"dict": {str(key): _freeze(item, arrays) for key, item in value.items()}}
    if dataclasses.is_dataclass(value):
        fields = {f.name: _freeze(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
        return {"is": type(value).__name__, "fields": fields}
    raise TypeError(f"cannot be kept in a checkpoint: {type(value).__name__}")


def _thaw(tree: Any, arrays: Mapping[str, NDArray[Any]], kinds: dict[str, type]) -> Any:
    if isinstance(tree, list):
        return [_thaw(item, arrays, kinds) for item in tree]
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "tuple" in tree:
        return tuple(_thaw(item, arrays, kinds) for item in tree["tuple"])
    if "dict" in tree:
        return {key: _thaw(item, arrays, kinds) for key, item in tree["dict"].items()}
    return kinds[tree["is"]](**{name: _thaw(item, arrays, kinds) for name, item in tree["fields"].items()})
