"""Processor time of a solver, without what its listener takes."""

import time
from collections.abc import Callable

from kiln_workers.fit.solution import OnEpoch, Representation, nobody


class Stopwatch:
    """Counts the processor time of the process from its making; `tell` stops it while somebody listens."""

    def __init__(self, on_epoch: OnEpoch) -> None:
        self._on_epoch = on_epoch
        self._began = time.process_time()

    @property
    def seconds(self) -> float:
        return time.process_time() - self._began

    def tell(self, epoch: int, where: Callable[[], Representation]) -> None:
        """Call the listener, if there is one, with where the solution stands."""
        if self._on_epoch is nobody:
            return
        paused = time.process_time()
        self._on_epoch(epoch, where())
        self._began += time.process_time() - paused
