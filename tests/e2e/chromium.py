"""The browser that the page is tested in."""

from __future__ import annotations

from pathlib import Path

import pytest

CHROMIUM = Path("/usr/bin/chromium")
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update",
             "--disable-sync"]  # fmt: skip

NEEDED = [pytest.mark.system, pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium")]
