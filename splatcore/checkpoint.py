"""The file that a run's state is kept in: written atomically, versioned, with digests.

A zip of `about.json` (what the state is of), `state.json` and one .npy file an array; `sha256.txt` holds a digest of
all of it. It is one file, so that it is replaced in one step: a kill at any moment leaves the old one or the new one.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import splatcore
from splatcore.durable import renamed
from splatcore.errors import CheckpointError
from splatcore.frozen import Arrays, freeze, thaw
from splatcore.options import Options
from splatcore.scan import Scan

FORMAT, VERSION = "splatct-checkpoint", 5


def identity(scan: Scan, options: Options) -> dict[str, Any]:
    """What a state belongs to: this program, this scan (all that a run reads of it), these options. The number of
    threads changes no bit of the result."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "software": splatcore.__version__,
        "scan": _digest(scan),
        "options": {name: value for name, value in options.to_dict().items() if name != "threads"},
    }


def write(path: Path, about: dict[str, Any], state: dict[str, Any]) -> int:
    """Keep a state. Returns the bytes written; raises OSError, and then what stood there still stands."""
    tree, arrays = freeze(state)
    texts = {"about.json": json.dumps(about, sort_keys=True), "state.json": json.dumps(tree)}
    with renamed(path) as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name, text in texts.items():
                archive.writestr(name, text)
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
            archive.writestr("sha256.txt", _digest_of(texts, arrays))
        return file.tell()


def read(path: Path, about: dict[str, Any], kinds: Iterable[type]) -> dict[str, Any]:
    """The state in a file, if it is of what `about` says. Raises CheckpointError where it is not, or damaged, and
    FileNotFoundError where there is none."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise CheckpointError(f"it cannot be read: {error.strerror or error}") from error
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            texts = {name: archive.read(name).decode() for name in ("about.json", "state.json")}
            found = json.loads(texts["about.json"])
            _compare(found, about)  # before the rest: another version may keep its state in another way
            names = [name for name in archive.namelist() if name.endswith(".npy")]
            arrays = {n.removesuffix(".npy"): _array(archive.read(n)) for n in names}
            whole = archive.read("sha256.txt").decode() == _digest_of(texts, arrays)
        state = thaw(json.loads(texts["state.json"]), arrays, kinds) if whole else None
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError, EOFError, NotImplementedError, RuntimeError) as error:
        raise CheckpointError(f"it is damaged ({type(error).__name__})") from error
    if not whole or not isinstance(state, dict):
        raise CheckpointError("it is damaged: its digest is another")
    return state


def _compare(found: Any, wanted: dict[str, Any]) -> None:
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise CheckpointError("it is no checkpoint of this program")
    if found.get("version") != VERSION:
        raise CheckpointError(f"it has version {found.get('version')}, expected {VERSION}")
    if found.get("software") != wanted["software"]:
        raise CheckpointError(f"it was made by version {found.get('software')}, this is {wanted['software']}")
    if found.get("scan") != wanted["scan"]:
        raise CheckpointError("it is of another scan")
    given = found.get("options")
    if given != wanted["options"]:
        other = given if isinstance(given, dict) else {}
        changed = [name for name, value in wanted["options"].items() if other.get(name, ...) != value]
        words = [f"{name} was {other.get(name)!r}, now {wanted['options'][name]!r}" for name in changed]
        raise CheckpointError(f"it was made with other options ({'; '.join(words)})")


def _array(data: bytes) -> NDArray[Any]:
    return np.asarray(np.lib.format.read_array(io.BytesIO(data), allow_pickle=False))


def _digest_of(texts: dict[str, str], arrays: Arrays) -> str:
    sha = hashlib.sha256()
    for name in ("about.json", "state.json"):
        sha.update(texts[name].encode())
    for name in sorted(arrays):
        _update(sha, name, arrays[name])
    return sha.hexdigest()


def _digest(scan: Scan) -> str:
    sha = hashlib.sha256()
    plain = {
        "beam": scan.frames.beam, "shape": [scan.frames.rows, scan.frames.cols], "volume": scan.volume.to_json(),
        "time_s": scan.time_s, "tolerance": None if scan.tolerance is None else vars(scan.tolerance),
    }  # fmt: skip
    sha.update(json.dumps(plain, sort_keys=True).encode())
    _update(sha, "projections", scan.projections)
    _update(sha, "frames", scan.frames.packed())
    if scan.bad_pixels is not None:
        _update(sha, "bad_pixels", scan.bad_pixels)
    return sha.hexdigest()


def _update(sha: Any, name: str, array: NDArray[Any]) -> None:
    sha.update(f"{name} {array.dtype.str} {array.shape}".encode())
    sha.update(np.ascontiguousarray(array).data)
