"""Keeps the C library from growing a heap for each thread."""

from __future__ import annotations

import ctypes

_M_ARENA_MAX = -8  # malloc.h


def share_one_heap() -> None:
    """Before threads start. By default glibc gives each a heap of its own, up to eight for a processor, and what was
    freed in one is of no use to the others: a server whose pool takes turns grows by that for hours. Python allocates
    under its own lock, so that one heap keeps hardly anybody waiting. Other C libraries have no such heaps."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)
