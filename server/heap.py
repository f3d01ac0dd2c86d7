"""How the server's process holds memory, so that it does not grow with the requests it has answered."""

from __future__ import annotations

import ctypes
import gc

_M_ARENA_MAX = -8  # malloc.h


def share_one_heap() -> None:
    """Before threads start. By default glibc gives each a heap of its own, up to eight for a processor, and what was
    freed in one is of no use to the others: a server whose pool takes turns grows by that for hours. Python allocates
    under its own lock, so that one heap keeps hardly anybody waiting. Other C libraries have no such heaps."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)


def leave_what_is_loaded() -> None:
    """Once all is loaded. The collector looks at old objects only when a quarter as many have grown old since; modules
    have more than a hundred thousand, so that much rubbish would wait, and the process hold as much as ever waited."""
    gc.collect()
    gc.freeze()
