"""The order in which texels train, and the bounded window of images through which they stream.

An epoch visits every texel once. Its order is a pure function of (seed, epoch, tile counts): tiles are shuffled and
packed into chunks, and the texels of a chunk are shuffled among themselves. If all texels fit into the window there is
one chunk, read once; otherwise a chunk holds half a window, and while one is consumed the next is read, so no more
than `window` images are ever in memory. Batches follow each other through the infinite sequence of epochs, so step k
alone says where a resumed fit goes on.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from kiln_workers.fit.source import Float16, Float32, Index, TexelSource


@dataclass(frozen=True)
class Chunk:
    """Texels that train together: parts of tiles and the order over their concatenation."""

    parts: tuple[tuple[int, Index], ...]  # (tile, its texels)
    order: Index  # [n]

    def __len__(self) -> int:
        return len(self.order)


def plan_epoch(seed: int, epoch: int, counts: Sequence[int], window: int) -> list[Chunk]:
    """The chunks of an epoch, in order."""
    rng = np.random.default_rng([seed, 0x65706F, epoch])
    total = sum(counts)
    capacity = total if total <= window else max(1, window // 2)
    chunks: list[Chunk] = []
    parts: list[tuple[int, Index]] = []
    room = capacity
    for tile in rng.permutation(len(counts)):
        left = np.arange(counts[tile], dtype=np.int64)
        while len(left):
            parts.append((int(tile), left[:room]))
            taken = len(parts[-1][1])
            left, room = left[taken:], room - taken
            if room == 0:
                chunks.append(_shuffled(parts, rng))
                parts, room = [], capacity
    if parts:
        chunks.append(_shuffled(parts, rng))
    return chunks


def _shuffled(parts: list[tuple[int, Index]], rng: np.random.Generator) -> Chunk:
    return Chunk(tuple(parts), rng.permutation(sum(len(texels) for _, texels in parts)))


@dataclass(frozen=True)
class Batch:
    images: Float16  # [B, R, R, 3]
    normals: Float32  # [B, 3]


class TexelStream:
    """Batches of a source, from any step on."""

    def __init__(self, source: TexelSource, seed: int, batch: int, window: int) -> None:
        self._source, self._seed, self._batch, self._window = source, seed, batch, window
        self._total = sum(source.counts)
        self._in_memory = self._total <= window

    def batches(self, first_step: int) -> Iterator[Batch]:
        """Batches of steps `first_step`, `first_step` + 1, ... without end."""
        images, normals, held = [], [], 0
        for chunk_images, chunk_normals in self._texels(first_step * self._batch):
            start = 0
            while start < len(chunk_images):
                stop = min(start + self._batch - held, len(chunk_images))
                images.append(chunk_images[start:stop])
                normals.append(chunk_normals[start:stop])
                held, start = held + stop - start, stop
                if held == self._batch:
                    yield Batch(np.concatenate(images), np.concatenate(normals))
                    images, normals, held = [], [], 0

    def _texels(self, position: int) -> Iterator[tuple["_Shuffled", Float32]]:
        """Chunks from a position in the infinite sequence on, the next one read while one is consumed."""
        if self._in_memory:
            yield from self._memory_texels(position)
            return
        with ThreadPoolExecutor(1, thread_name_prefix="prefetch") as reader:
            plan = self._chunks(position)
            skip, chunk = next(plan)
            pending: Future[tuple[Float16, Float32]] = reader.submit(self._read, chunk)
            while True:
                (images, normals), order = pending.result(), chunk.order[skip:]
                skip, chunk = next(plan)
                pending = reader.submit(self._read, chunk)
                yield _Shuffled(images, order), normals[order]
                del images, normals

    def _memory_texels(self, position: int) -> Iterator[tuple["_Shuffled", Float32]]:
        everything = Chunk(
            tuple((tile, np.arange(count, dtype=np.int64)) for tile, count in enumerate(self._source.counts)),
            np.arange(self._total),
        )
        images, normals = self._read(everything)
        starts = np.concatenate([[0], np.cumsum(self._source.counts)])
        for skip, chunk in self._chunks(position):
            places = np.concatenate([starts[tile] + texels for tile, texels in chunk.parts])
            order = places[chunk.order[skip:]]
            yield _Shuffled(images, order), normals[order]

    def _chunks(self, position: int) -> Iterator[tuple[int, Chunk]]:
        """(Texels to skip, chunk) from a position on, epoch after epoch."""
        epoch, skip = divmod(position, self._total)
        while True:
            for chunk in plan_epoch(self._seed, epoch, self._source.counts, self._window):
                if skip >= len(chunk):
                    skip -= len(chunk)
                    continue
                yield skip, chunk
                skip = 0
            epoch += 1

    def _read(self, chunk: Chunk) -> tuple[Float16, Float32]:
        size = self._source.image_size
        images = np.empty((len(chunk), size, size, 3), np.float16)
        normals = np.empty((len(chunk), 3), np.float32)
        start = 0
        for tile, texels in chunk.parts:
            stop = start + len(texels)
            images[start:stop] = self._source.images(tile, texels)
            normals[start:stop] = self._source.normals(tile)[texels]
            start = stop
        return images, normals


class _Shuffled:
    """Images seen in an order, copied only where sliced."""

    def __init__(self, images: Float16, order: Index) -> None:
        self._images, self._order = images, order

    def __len__(self) -> int:
        return len(self._order)

    def __getitem__(self, part: slice) -> Float16:
        return self._images[self._order[part]]
