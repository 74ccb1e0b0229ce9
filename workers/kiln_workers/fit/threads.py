"""A pool whose torch kernels run on one thread each, so that results do not depend on how many threads there are.

Denormal numbers are flushed to zero: Adam's moments of dead features decay into them, and they are slow.
torch keeps the number of kernel threads partly per thread and partly per process; both are set, and the caller's
number comes back when the pool closes.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch


@contextmanager
def single_threaded_pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """A pool of `threads` threads; inside, torch operators of these and of the calling thread use no others."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads, "fit", initializer=_prepare_thread) as pool:
            yield pool
    finally:
        torch.set_num_threads(before)


def _prepare_thread() -> None:
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
