"""Which names an uploaded file may have: ones that mean the same harmless thing on every system."""

from __future__ import annotations

import unicodedata

_PORTS = (f"{port}{n}" for port in ("com", "lpt") for n in "0123456789¹²³")  # Windows takes these digits, too
_DEVICES = frozenset({"con", "prn", "aux", "nul", "conin$", "conout$", *_PORTS})
_LONGEST = 255  # bytes, the limit of common file systems


def fault(name: str) -> str | None:
    """What is wrong with a file name, or None. The name itself is not repeated."""
    if not name or name in (".", ".."):
        return "is empty or a folder"
    if any(character in '/\\:*?"<>|' for character in name):
        return 'holds one of / \\ : * ? " < > |'
    if any(unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp") for character in name):
        return "holds a control character"
    if unicodedata.normalize("NFC", name) != name:
        return "is not in Unicode normal form C"
    if len(name.encode()) > _LONGEST:
        return f"is longer than {_LONGEST} bytes"
    if name.split(".")[0].rstrip().lower() in _DEVICES:
        return "is a device name on Windows"
    if name.startswith(".") or name[-1] in ". ":
        return "starts with a dot, or ends with a dot or a space"
    return None


def key(name: str) -> str:
    """Equal for names that a case-insensitive file system takes for one."""
    return unicodedata.normalize("NFC", name.casefold())
