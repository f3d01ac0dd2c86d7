"""Instruction sets: a test that asks for `isa` runs on each one that this processor has."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from splatcore import _native

from .isas import available


@pytest.fixture(params=available())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    from splatcore import ops

    name: str = _native.choose_isa(request.param)
    ops.forget_renderers()
    yield name
    _native.choose_isa(None)
    ops.forget_renderers()
