"""Which addresses the server may be sent to by somebody's URL: none of its own network, unless it is allowed.

The name is resolved here, once, and the connection goes to the address that was judged: a name that means
something else a moment later leads nowhere.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network

_UNICAST = ipaddress.IPv6Network("2000::/3")  # all else is special, whatever `is_global` makes of it
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")


class Forbidden(Exception):
    """The name leads where it must not, or nowhere; the text says which."""


def networks(text: str) -> tuple[Network, ...]:
    """Networks and addresses, comma between. Raises ValueError."""
    return tuple(ipaddress.ip_network(part.strip()) for part in text.split(",") if part.strip())


async def checked(host: str, port: int, allowed: tuple[Network, ...]) -> str:
    """The address to connect to. If a name has several, all must be fit: it is not ours to pick the good ones."""
    addresses = await resolved(host, port)
    for address in addresses:
        if "%" in address or not _fit(ipaddress.ip_address(address), allowed):
            raise Forbidden("it leads to a private or local address, and SPLATCT_WEBHOOK_ALLOW does not list it")
    return addresses[0]


async def resolved(host: str, port: int) -> list[str]:
    try:
        found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        raise Forbidden("its name cannot be resolved") from None
    return [str(entry[4][0]) for entry in found]


def _fit(address: Address, allowed: tuple[Network, ...]) -> bool:
    address = _meant(address)
    if any(address in network for network in allowed):
        return True
    if isinstance(address, ipaddress.IPv6Address) and address not in _UNICAST:
        return False
    return address.is_global and not address.is_multicast


def _meant(address: Address) -> Address:
    """The IPv4 address inside an IPv6 one that stands for it."""
    if isinstance(address, ipaddress.IPv4Address):
        return address
    if address in _NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    teredo = address.teredo
    return address.ipv4_mapped or address.sixtofour or (teredo[1] if teredo else address)
