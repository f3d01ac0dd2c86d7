from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from .stack import Stack


@pytest.fixture
def stack(tmp_path: Path) -> Iterator[Stack]:
    """A service of one's own, for tests that break things."""
    with Stack(tmp_path) as running:
        yield running


@pytest.fixture(scope="session")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """The same with keys: `http` has one of tenant `first` that may do all."""
    with Stack(tmp_path_factory.mktemp("keyed")) as running:
        running.http.headers["Authorization"] = f"Bearer {running.new_key('first', 'admin')[1]}"
        running.start_worker()
        yield running


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A service that the tests which break nothing share, with one worker."""
    with Stack(tmp_path_factory.mktemp("stack")) as running:
        running.start_worker()
        yield running
