"""Loaded by every Python process of a farm whose clock is set: `time.sleep` that libfaketime leaves alone.

Python 3.11 sleeps by `clock_nanosleep` until a time of the monotonic clock, which libfaketime 0.9.10 (Debian 12) turns
into an invalid time even where it is told not to touch that clock.
"""

import select
import time


def sleep(seconds: float) -> None:
    """Sleep for so many seconds."""
    select.select([], [], [], seconds)


time.sleep = sleep
