"""Where webhooks may go: any http or https URL but addresses at which machines of a cloud tell secrets, or nobody is.

The coordinator calls what an administrator names, from within the farm's network, so private addresses and the machine
itself are allowed: receivers are there. Refused are link-local addresses (the metadata services of clouds and what else
answers without a password), the few metadata services at other addresses, unspecified, multicast and reserved ones. A
name is resolved when something is sent, and held to the same rule then (`kiln_service.webhooks`).
"""

import ipaddress
import socket
from typing import Final
from urllib.parse import urlsplit

Address = ipaddress.IPv4Address | ipaddress.IPv6Address

METADATA: Final = frozenset(map(ipaddress.ip_address, ("fd00:ec2::254", "100.100.100.200", "192.0.0.192")))


def is_refused(address: Address) -> bool:
    """Whether nothing is ever sent to this address."""
    mapped = getattr(address, "ipv4_mapped", None)
    if mapped is not None:
        return is_refused(mapped)
    return (
        address.is_link_local
        or address.is_multicast
        or address.is_unspecified
        or (address.is_reserved and not address.is_loopback)
        or address in METADATA
    )


def check_receiver(url: str) -> str:
    """The URL unchanged, ValueError where its port is none or its host is written as an address that is refused."""
    parts = urlsplit(url)
    host = parts.hostname
    if not host or parts.port == 0:  # `port` raises ValueError itself where it is no number up to 65535
        raise ValueError("names no host and port")
    address = written_address(host)
    if address is not None and is_refused(address):
        raise ValueError(f"{address} is link-local, a metadata service, or nobody's address")
    return url


def written_address(host: str) -> Address | None:
    """The address that a host is written as, in any form that resolvers take (`2852039166`, `0xa9.254.1`)."""
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        pass
    try:
        return ipaddress.IPv4Address(socket.inet_aton(host))
    except OSError:
        return None
