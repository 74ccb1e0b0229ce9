"""Identifiers that sort by the time they were made: UUID version 7 (RFC 9562, 5.7) as 32 hexadecimal digits."""

import secrets
import time


def new_id() -> str:
    """48 bits of milliseconds since 1970, the version and variant bits, 74 random bits."""
    value = (time.time_ns() // 1_000_000) << 80 | secrets.randbits(80)
    value = value & ~(0xF << 76) | 0x7 << 76
    value = value & ~(0x3 << 62) | 0x2 << 62
    return f"{value:032x}"
