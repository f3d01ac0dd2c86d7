"""Headers that every answer carries, whoever makes it: what a browser may do with it."""

from __future__ import annotations

from starlette.datastructures import MutableHeaders

_ALWAYS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
    "object-src 'none'; base-uri 'none'; frame-ancestors 'none'; form-action 'self'",
}
_YEAR_S = 365 * 24 * 3600


def add_to(headers: MutableHeaders, scheme: str, path: str) -> None:
    """Where an answer has its own, it keeps it."""
    for name, value in _ALWAYS.items():
        headers.setdefault(name, value)
    if path.startswith("/v1/"):
        headers.setdefault("Cache-Control", "no-store")  # it is one tenant's, and changes
    if scheme == "https":
        headers.setdefault("Strict-Transport-Security", f"max-age={_YEAR_S}")
