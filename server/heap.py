"""Keeps the C library from holding on to memory that Python has freed."""

from __future__ import annotations

import asyncio
import ctypes

_M_ARENA_MAX = -8  # malloc.h
_EVERY_S = 30.0


def share_one_heap() -> None:
    """Before threads start. By default glibc gives each a heap of its own, up to eight for a processor, and what was
    freed in one is of no use to the others: a server whose pool takes turns grows by that for hours. Python allocates
    under its own lock, so that one heap keeps hardly anybody waiting. Other C libraries have no such heaps."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)


async def keep_giving_back() -> None:
    """Give the system the whole pages of what is free, holes among what is in use included, which glibc otherwise
    keeps."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    while trim is not None:
        await asyncio.sleep(_EVERY_S)
        await asyncio.to_thread(trim, 0)
