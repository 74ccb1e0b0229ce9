"""How far adaptive sampling is, on standard error: a line written anew on a terminal, some lines elsewhere."""

import sys
import time
from types import TracebackType
from typing import Final, Self

from kiln_workers.shade.adaptive import Progress

BETWEEN_LINES_S: Final = 10.0
"""Seconds between two lines where standard error is no terminal."""


class SamplingLine:
    """Shows progress; ends its line when the sampling has ended."""

    def __init__(self, noise: float) -> None:
        self._noise = noise
        self._terminal = sys.stderr.isatty()
        self._next = 0.0
        self._open = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._open:
            print(file=sys.stderr)

    def show(self, progress: Progress) -> None:
        """Write the present state, unless the last line is recent."""
        text = sentence(progress, self._noise)
        if self._terminal:
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
            self._open = True
        elif time.monotonic() >= self._next:
            print(text, file=sys.stderr, flush=True)
            self._next = time.monotonic() + BETWEEN_LINES_S


def sentence(progress: Progress, noise: float) -> str:
    """What a person reads; the estimate changes with what is learnt of the noise, so it says `about`."""
    done, total = progress.paths / 1e6, (progress.paths + progress.paths_left) / 1e6
    minutes, seconds = divmod(round(progress.seconds_left), 60)
    return (
        f"noise {progress.noise:.4f} on average, {noise:g} at most is asked for: "
        f"{done:.1f} of about {total:.1f} million paths, about {minutes}:{seconds:02d} left"
    )
