"""Where webhooks may go: any http or https URL but addresses at which machines of a cloud tell secrets, or nobody is.

The coordinator calls what an administrator names, from within the farm's network, so private addresses and the machine
itself are allowed: receivers are there. Refused are link-local addresses (the metadata services of clouds and what else
answers without a password), the metadata services at other addresses, unspecified, multicast and reserved ones, also
where an IPv6 address stands for one of IPv4 (mapped, compatible, 6to4, Teredo, NAT64). A
name is resolved when something is sent, and held to the same rule then (`kiln_service.webhooks`).
"""

import ipaddress
import socket
from collections.abc import Iterator
from typing import Final
from urllib.parse import urlsplit

Address = ipaddress.IPv4Address | ipaddress.IPv6Address

METADATA: Final = tuple(
    map(
        ipaddress.ip_network,
        (
            "100.100.100.200/32",  # Alibaba Cloud
            "168.63.129.16/32",  # Azure
            "192.0.0.0/24",  # Oracle Cloud (192.0.0.192), and what else IETF has reserved there
            "fd00:ec2::/32",  # Amazon EC2: metadata (::254), name server (::253), time (::123), identities (::23)
            "fd20:ce::254/128",  # Google Cloud
            "fd00:c1::/32",  # Oracle Cloud
            "fd00:42::42/128",  # Scaleway
        ),
    )
)
"""Metadata services of clouds, and services beside them, that are not at link-local addresses."""
NAT64: Final = tuple(map(ipaddress.IPv6Network, ("64:ff9b::/96", "64:ff9b:1::/48")))
"""Of RFC 6052 and RFC 8215: the last 32 bits are an IPv4 address."""
V4_COMPATIBLE: Final = ipaddress.IPv6Network("::/96")
"""Of RFC 4291, 2.5.5.1, long out of use: the last 32 bits are an IPv4 address, but of `::` and `::1`."""
SITE_LOCAL: Final = ipaddress.IPv6Network("fec0::/10")
LAST_32: Final = 2**32 - 1


def is_refused(address: Address) -> bool:
    """Whether nothing is ever sent to this address, or to the IPv4 address that it stands for."""
    if isinstance(address, ipaddress.IPv6Address) and any(map(is_refused, _embedded(address))):
        return True
    if address.is_loopback:
        return False
    return (
        address.is_link_local
        or address.is_multicast
        or address.is_unspecified
        or (address.is_reserved and not _is_carrier(address))
        or any(address in network for network in METADATA)
        or (isinstance(address, ipaddress.IPv6Address) and address in SITE_LOCAL)
    )


def _embedded(address: ipaddress.IPv6Address) -> Iterator[ipaddress.IPv4Address]:
    """IPv4 addresses that packets to this one may reach in the end."""
    if address.ipv4_mapped is not None:
        yield address.ipv4_mapped
    if address.sixtofour is not None:
        yield address.sixtofour
    if address.teredo is not None:
        yield from address.teredo
    compatible = address in V4_COMPATIBLE and not address.is_unspecified and not address.is_loopback
    if compatible or any(address in network for network in NAT64):
        yield ipaddress.IPv4Address(int(address) & LAST_32)


def _is_carrier(address: Address) -> bool:
    """Whether it is reserved only for the IPv4 address that it stands for."""
    return isinstance(address, ipaddress.IPv6Address) and (
        address.ipv4_mapped is not None or any(address in network for network in NAT64)
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
