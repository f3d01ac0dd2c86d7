"""The instruction sets that this processor and build can run."""

from __future__ import annotations

from splatcore import _native


def available() -> list[str]:
    names = []
    for name in ("avx512", "avx2", "plain"):
        try:
            names.append(_native.choose_isa(name))
        except ValueError:
            pass
    _native.choose_isa(None)
    return names
