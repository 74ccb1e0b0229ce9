"""Content-addressed bytes: objects named by their sha256 in a folder or a bucket, and the table that vouches for them.

An upload grows in a temporary file, is hashed on the way, and becomes an object only when its hash is the
promised one. The row in `blobs` is written last, after the object is durable (locally: fsync of the file and of the
folder that names it; obstore does neither), so an object without a row is nothing and a row without an object
does not happen. Publication and collection of the same blob exclude each other by an advisory lock on its hash.
"""

import asyncio
import contextlib
import hashlib
import os
import shutil
import tempfile
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from datetime import timedelta
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final
from urllib.parse import unquote, urlparse

import obstore
import psycopg
from obstore.exceptions import BaseError
from obstore.store import ObjectStore, from_url

from kiln_schemas.errors import DISK_FULL, InputError, MachineLacks, NotFound, TooLarge, Truncated, Unreachable
from kiln_service.config import Limits
from kiln_service.db import Database, Tx
from kiln_service.ids import new_id

if TYPE_CHECKING:
    from obstore import GetResult
    from obstore.store import ClientConfig, RetryConfig, S3Config

WRITE_BYTES: Final = 2**20
"""Uploads go to the disk in pieces of at least this size."""
READ_BYTES: Final = 2**20
READ_GAP: Final = 2**16
"""Parts of a blob that lie closer are read at once."""


RETRIES: Final["RetryConfig"] = {"max_retries": 4, "retry_timeout": timedelta(seconds=20)}
"""A bucket that does not answer is asked again for so long, then the client is told, who asks again as well."""


def open_objects(url: str) -> ObjectStore:
    """The objects under a `file://` or `s3://` URL; an S3 server in `AWS_ENDPOINT_URL` may speak plain HTTP."""
    if not url.startswith("s3://"):
        return from_url(url)
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
    options: ClientConfig = {"allow_http": endpoint.startswith("http://"), "connect_timeout": timedelta(seconds=5)}
    config: S3Config = {"endpoint": endpoint} if endpoint else {}
    return from_url(url, config=config, client_options=options, retry_config=RETRIES)


class Blobs:
    """The blobs of one coordinator."""

    def __init__(self, database: Database, url: str, incoming: Path, limits: Limits) -> None:
        self._database = database
        self._incoming = incoming
        self._limits = limits
        self._folder = local_folder(url)
        for folder in filter(None, (self._incoming, self._folder)):
            folder.mkdir(parents=True, exist_ok=True)
        self._objects: ObjectStore = open_objects(url)

    async def receive(self, sha256: str, body: AsyncIterator[bytes], length: int | None) -> int:
        """Take an upload whole or not at all; its size in bytes. `length` is the announced Content-Length."""
        self._check_size(length or 0)
        with _no_space_is_507(self._incoming), self._temporary() as file:
            digest, size = await self._drain(body, file)
            if length is not None and size != length:
                raise Truncated(
                    f"the body has {size} bytes, Content-Length announced {length}",
                    where=sha256,
                    remedy="Upload the whole file again.",
                )
            if digest != sha256:
                raise InputError(
                    f"the bytes uploaded have sha256 {digest}",
                    where=sha256,
                    remedy="The file changed after it was hashed, or was damaged on the way: hash and upload it again.",
                )
            await asyncio.to_thread(_flush, file)
            await self._publish(sha256, size, Path(file.name))
        return size

    async def missing(self, hashes: Iterable[str]) -> list[str]:
        """Those that are not here, in the order given; those that are here are kept for the grace period."""
        wanted = list(dict.fromkeys(hashes))
        async with self._database.transaction() as tx:
            here = {row["sha256"] for row in await tx.all("touch_blobs", hashes=wanted)}
        return [sha256 for sha256 in wanted if sha256 not in here]

    async def size(self, sha256: str) -> int:
        """Bytes of a blob; NotFound where it is not here."""
        async with self._database.transaction() as tx:
            row = await tx.maybe("find_blob", sha256=sha256)
        if row is None:
            raise NotFound(f"no blob {sha256}", where="blobs")
        return int(row["size"])

    async def read(self, sha256: str, start: int, end: int) -> AsyncIterator[bytes]:
        """Bytes start..end-1 of a blob in pieces; Unreachable or NotFound where they are not to be had."""
        if start == end:
            return _nothing()
        try:
            with _storage_errors():
                result = await obstore.get_async(self._objects, _key(sha256), options={"range": (start, end)})
        except FileNotFoundError:
            raise NotFound(
                f"the storage has lost blob {sha256}", where="storage", remedy="Restore the blobs from a backup."
            ) from None
        return _pieces(result)

    async def read_parts(self, sha256: str, starts: Sequence[int], length: int) -> list[bytes]:
        """So many bytes of a blob from each of these places on."""
        with _storage_errors():
            parts = await obstore.get_ranges_async(
                self._objects, _key(sha256), starts=starts, lengths=[length] * len(starts), coalesce=READ_GAP
            )
        return [bytes(part) for part in parts]

    async def take(self, body: AsyncIterator[bytes]) -> str:
        """Take an upload whose hash nobody has told; its sha256."""
        self._check_size(0)
        with _no_space_is_507(self._incoming), self._temporary() as file:
            digest, size = await self._drain(body, file)
            await asyncio.to_thread(_flush, file)
            await self._publish(digest, size, Path(file.name))
        return digest

    async def collect(self, grace_s: float) -> int:
        """Delete blobs that nothing uses and nobody asked for within the grace period; how many."""
        async with self._database.transaction() as tx:
            candidates = [row["sha256"] for row in await tx.all("unused_blobs", seconds=grace_s)]
        collected = 0
        for sha256 in candidates:
            with contextlib.suppress(psycopg.errors.ForeignKeyViolation):  # someone began to use it just now
                collected += await self._collect_one(sha256, grace_s)
        return collected

    async def _collect_one(self, sha256: str, grace_s: float) -> int:
        """The row first: cut off in between, an object is left that nothing vouches for, and never the reverse."""
        async with self._database.transaction() as tx:
            await tx.run("lock_blob", sha256=sha256)
            deleted = await tx.count("delete_unused_blob", sha256=sha256, seconds=grace_s)
        if deleted:
            async with self._database.transaction() as tx:
                await tx.run("lock_blob", sha256=sha256)
                if await tx.maybe("find_blob", sha256=sha256) is None:  # else it was uploaded again just now
                    with _storage_errors():
                        await obstore.delete_async(self._objects, _key(sha256))
        return deleted

    async def check(self) -> None:
        """Write and delete a small object; Unreachable where the storage does not take it."""
        key = f"probe-{new_id()}"
        with _no_space_is_507(self._incoming), _storage_errors():
            await obstore.put_async(self._objects, key, b"lightkiln")
            await obstore.delete_async(self._objects, key)

    def sweep_incoming(self) -> None:
        """Delete uploads that a killed coordinator left; only while no other coordinator uses the folder."""
        for left in self._incoming.iterdir():
            left.unlink(missing_ok=True)

    def _check_size(self, size: int) -> None:
        if size > self._limits.blob_bytes:
            raise TooLarge(
                f"{size} bytes are more than {self._limits.blob_bytes}",
                where="blob",
                remedy="Raise limits.blob_bytes of the coordinator.",
            )
        for folder in filter(None, (self._incoming, self._folder)):
            free = shutil.disk_usage(folder).free
            if free < size + self._limits.reserve_bytes:
                raise MachineLacks(
                    f"{free} bytes are free, {size} and a reserve of {self._limits.reserve_bytes} are needed",
                    where=str(folder),
                    remedy="Free disk space on the coordinator's machine.",
                )

    async def _drain(self, body: AsyncIterator[bytes], file: IO[bytes]) -> tuple[str, int]:
        """Write and hash the body in a thread, in large pieces; its sha256 and size."""
        digest, size = hashlib.sha256(), 0
        pieces: list[bytes] = []
        held = 0

        def write(data: bytes) -> None:
            digest.update(data)
            file.write(data)

        async for piece in body:
            pieces.append(piece)
            held, size = held + len(piece), size + len(piece)
            if held >= WRITE_BYTES:
                self._check_size(size)
                await asyncio.to_thread(write, b"".join(pieces))
                pieces, held = [], 0
        await asyncio.to_thread(write, b"".join(pieces))
        return digest.hexdigest(), size

    async def _publish(self, sha256: str, size: int, file: Path) -> None:
        if self._folder is None:
            await self._put(sha256, file)  # before the transaction: a slow bucket must not use up the connections
        async with self._database.transaction() as tx:
            await tx.run("lock_blob", sha256=sha256)
            if not await tx.all("touch_blobs", hashes=[sha256]):
                await self._place(sha256, file)
                await tx.run("insert_blob", sha256=sha256, size=size)

    async def _place(self, sha256: str, file: Path) -> None:
        """Make the object durable; the blob is locked."""
        if self._folder is not None:
            await asyncio.to_thread(_move_durably, file, self._folder / _key(sha256))
            return
        try:
            with _storage_errors():
                await obstore.head_async(self._objects, _key(sha256))
        except FileNotFoundError:  # collected after it was put and before it was locked
            await self._put(sha256, file)

    async def _put(self, sha256: str, file: Path) -> None:
        with _storage_errors():
            await obstore.put_async(self._objects, _key(sha256), file)

    @contextlib.contextmanager
    def _temporary(self) -> Iterator[IO[bytes]]:
        """A file that is gone after the block, unless it was moved away."""
        with tempfile.NamedTemporaryFile(dir=self._incoming, prefix="upload-", delete=False) as file:
            try:
                yield file
            finally:
                Path(file.name).unlink(missing_ok=True)


async def require_blobs(tx: Tx, hashes: Iterable[str]) -> list[str]:
    """Those of the hashes that are not here, the others locked against collection until the transaction ends."""
    wanted = sorted(set(hashes))
    here = {row["sha256"] for row in await tx.all("hold_blobs", hashes=wanted)}
    return [sha256 for sha256 in wanted if sha256 not in here]


async def use_blobs(tx: Tx, owner: str, hashes: Iterable[str]) -> None:
    """Keep blobs as long as `owner` uses them."""
    await tx.run("add_blob_uses", owner=owner, hashes=sorted(set(hashes)))


async def drop_blobs(tx: Tx, *owners: str) -> None:
    """`owners` no longer use any blob."""
    await tx.run("drop_blob_uses", owners=list(owners))


async def _nothing() -> AsyncIterator[bytes]:
    return
    yield b""


async def _pieces(result: "GetResult") -> AsyncIterator[bytes]:
    async for piece in result.stream(min_chunk_size=READ_BYTES):
        yield bytes(piece)


@contextlib.contextmanager
def _storage_errors() -> Iterator[None]:
    """A storage that does not answer or refuses is Unreachable: whoever asked tries again."""
    try:
        yield
    except FileNotFoundError:
        raise
    except BaseError as error:
        raise Unreachable(
            f"the blob storage does not answer: {_first_line(error)}",
            where="storage",
            remedy="Check the storage's address, credentials and bucket.",
        ) from None


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _key(sha256: str) -> str:
    return f"{sha256[:2]}/{sha256}"


def local_folder(url: str) -> Path | None:
    """The folder of a file:// URL, None for other storage."""
    parts = urlparse(url)
    return Path(unquote(parts.path)) if parts.scheme == "file" else None


def _flush(file: IO[bytes]) -> None:
    file.flush()
    os.fsync(file.fileno())


def _move_durably(file: Path, place: Path) -> None:
    """Give a synced file its final name, and sync the folders that name it."""
    known = place.parent.exists()
    place.parent.mkdir(exist_ok=True)
    file.replace(place)
    for folder in (place.parent,) if known else (place.parent, place.parent.parent):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextlib.contextmanager
def _no_space_is_507(folder: Path) -> Iterator[None]:
    """Translate a full disk into MachineLacks."""
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        raise MachineLacks(
            f"the disk is full: {error.strerror}",
            where=str(folder),
            remedy="Free disk space on the coordinator's machine.",
        ) from None
