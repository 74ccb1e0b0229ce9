"""Content-addressed bytes: objects named by their sha256 in a folder or a bucket, and the table that vouches for them.

An upload grows in a temporary file, is hashed on the way, and becomes an object only when its hash is the
promised one. The row in `blobs` is written last, after the object is durable (locally: fsync of the file and of the
folder that names it; obstore does neither), so an object without a row is nothing. Publication and collection of the
same blob exclude each other by an advisory lock on its hash.

A disk may damage or lose an object later. Whole blobs are hashed again while they are sent, parts are checked by the
object's size. Who asks whether a blob is here learns of damage too: it is hashed again unless it was read whole within
the last hour and not written since. A blob that is found damaged is marked: nobody is told any more that it is here, so
whoever has the bytes uploads them again, and an upload always replaces the object. `on_damage` tells those who can make
the bytes again (`kiln_service.damage`).
"""

import asyncio
import contextlib
import hashlib
import logging
import os
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final

import obstore
import psycopg
from obstore.exceptions import BaseError
from obstore.store import ObjectStore, from_url

from kiln_schemas.errors import DISK_FULL, Damaged, InputError, MachineLacks, NotFound, TooLarge, Truncated, Unreachable
from kiln_service.config import ServiceConfig
from kiln_service.db import Database, Tx
from kiln_service.disk import Disk, local_folder
from kiln_service.ids import new_id
from kiln_service.quota import Quota, Upload

if TYPE_CHECKING:
    from obstore import GetResult
    from obstore.store import ClientConfig, RetryConfig, S3Config

log = logging.getLogger(__name__)

WRITE_BYTES: Final = 2**20
"""Uploads go to the disk in pieces of at least this size."""
READ_BYTES: Final = 2**20
READ_GAP: Final = 2**16
"""Parts of a blob that lie closer are read at once."""
WHOLE_S: Final = 3600.0
"""So long a blob that was read whole is believed to be whole still."""
WHOLE_BLOBS: Final = 2**16
"""Of so many blobs it is kept in mind when they were read whole."""
EXAMINED_BYTES: Final = 2**30
"""At most so much is read for one question; of more, the smallest blobs are."""


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


async def _nobody(sha256: str) -> None:
    """There is nobody to be told of damage."""


class Blobs:
    """The blobs of one coordinator."""

    def __init__(
        self, database: Database, config: ServiceConfig, on_damage: Callable[[str], Awaitable[None]] = _nobody
    ) -> None:
        url = config.blob_base
        self._database = database
        self._incoming = config.incoming
        self._limits = config.limits
        self._disk = Disk(config)
        self._quota = Quota(database, config.limits)
        self._on_damage = on_damage
        self._folder = local_folder(url)
        for folder in filter(None, (self._incoming, self._folder)):
            folder.mkdir(parents=True, exist_ok=True)
        self._objects: ObjectStore = open_objects(url)
        self._found_whole: dict[str, tuple[str | None, float]] = {}

    async def receive(self, sha256: str, body: AsyncIterator[bytes], length: int | None, token: str) -> int:
        """Take an upload whole or not at all; its size in bytes. `length` is the announced Content-Length.

        QuotaExceeded where the token of this name has stored too much that no job uses.
        """
        self._check_size(length or 0)
        async with self._quota.upload(token) as upload:
            self._quota.grow(upload, length or 0)
            with _no_space_is_507(self._incoming), self._temporary() as file:
                return await self._receive(sha256, body, length, upload, file)

    async def _receive(
        self, sha256: str, body: AsyncIterator[bytes], length: int | None, upload: Upload, file: IO[bytes]
    ) -> int:
        digest, size = await self._drain(body, file, upload)
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
        await self._publish(sha256, size, Path(file.name), upload.token)
        return size

    async def missing(self, hashes: Iterable[str]) -> list[str]:
        """Those that are not here or damaged, in the order given; the others are kept for the grace period."""
        wanted = list(dict.fromkeys(hashes))
        async with self._database.transaction() as tx:
            here = {row["sha256"]: int(row["size"]) for row in await tx.all("touch_blobs", hashes=wanted)}
        whole = here.keys() - await self._damaged_of(here)
        return [sha256 for sha256 in wanted if sha256 not in whole]

    async def _damaged_of(self, sizes: Mapping[str, int]) -> set[str]:
        """Those of some blobs that are damaged, of at most `EXAMINED_BYTES`: the smallest that were not read lately."""
        damaged: set[str] = set()
        left = EXAMINED_BYTES
        for sha256, size in sorted(sizes.items(), key=lambda item: item[1]):
            if await self._was_whole(sha256):
                continue
            left -= size
            if left < 0:
                break
            try:
                await self._doubt(sha256)
            except Damaged:
                damaged.add(sha256)
        return damaged

    async def _was_whole(self, sha256: str) -> bool:
        """Whether the object was read whole within the last hour and not written since."""
        version, when = self._found_whole.get(sha256, (None, 0.0))
        return version is not None and time.monotonic() - when < WHOLE_S and await self._version(sha256) == version

    def _note_whole(self, sha256: str, version: str | None) -> None:
        self._found_whole.pop(sha256, None)
        self._found_whole[sha256] = version, time.monotonic()
        if len(self._found_whole) > WHOLE_BLOBS:
            del self._found_whole[next(iter(self._found_whole))]

    async def size(self, sha256: str) -> int:
        """Bytes of a blob; NotFound where it is not here, Damaged where its bytes are known to be damaged."""
        async with self._database.transaction() as tx:
            row = await tx.maybe("find_blob", sha256=sha256)
        if row is None:
            raise NotFound(f"no blob {sha256}", where="blobs")
        if row["damaged"]:
            await self._on_damage(sha256)
            raise _damaged(sha256)
        return int(row["size"])

    async def read(self, sha256: str, start: int, end: int) -> AsyncIterator[bytes]:
        """Bytes start..end-1 of a blob in pieces; Unreachable, NotFound or Damaged where they are not to be had.

        Where they are all of the blob, its last piece comes only if their hash is right.
        """
        size = await self.size(sha256)
        if start == end:
            return _nothing()
        try:
            with _storage_errors():
                result = await obstore.get_async(self._objects, _key(sha256), options={"range": (start, end)})
        except (FileNotFoundError, Unreachable):
            await self._doubt(sha256)
            raise
        if result.meta["size"] != size:
            await self._doubt(sha256)
        return self._checked(sha256, result) if (start, end) == (0, size) else _pieces(result)

    async def read_parts(self, sha256: str, starts: Sequence[int], length: int) -> list[bytes]:
        """So many bytes of a blob from each of these places on."""
        try:
            with _storage_errors():
                parts = await obstore.get_ranges_async(
                    self._objects, _key(sha256), starts=starts, lengths=[length] * len(starts), coalesce=READ_GAP
                )
        except (FileNotFoundError, Unreachable):
            await self._doubt(sha256)
            raise
        return [bytes(part) for part in parts]

    async def _checked(self, sha256: str, result: "GetResult") -> AsyncIterator[bytes]:
        """A whole blob's pieces; the last one is held back until the hash of all is known to be right."""
        digest, held = hashlib.sha256(), b""
        async for piece in _pieces(result):
            if held:
                yield held
            held = piece
            await asyncio.to_thread(digest.update, piece)
        if digest.hexdigest() != sha256:
            await self._doubt(sha256)
            raise Unreachable(f"blob {sha256} was read wrong once", where="storage")
        self._note_whole(sha256, result.meta["e_tag"])
        yield held

    async def _doubt(self, sha256: str) -> None:
        """Read a blob again; Damaged where its bytes are not what was uploaded, which is noted.

        An upload may replace the object meanwhile: the mark is for the object that was read.
        """
        bad, version = await self._examine(sha256)
        if not bad:
            self._note_whole(sha256, version)
            return
        self._found_whole.pop(sha256, None)
        async with self._database.transaction() as tx:
            await tx.run("lock_blob", sha256=sha256)
            if await self._version(sha256) != version:
                return
            await tx.run("mark_damaged", sha256=sha256)
        log.error("the bytes of blob %s are damaged or gone", sha256)
        await self._on_damage(sha256)
        raise _damaged(sha256)

    async def _examine(self, sha256: str) -> tuple[bool, str | None]:
        """Whether the bytes of an object are wrong, and the version of it that was read; None where there is none."""
        digest = hashlib.sha256()
        try:
            with _storage_errors():
                result = await obstore.get_async(self._objects, _key(sha256))
                async for piece in _pieces(result):
                    await asyncio.to_thread(digest.update, piece)
        except FileNotFoundError:
            return True, None
        return digest.hexdigest() != sha256, result.meta["e_tag"]

    async def _version(self, sha256: str) -> str | None:
        try:
            with _storage_errors():
                return (await obstore.head_async(self._objects, _key(sha256)))["e_tag"]
        except FileNotFoundError:
            return None

    async def take(self, body: AsyncIterator[bytes], token: str) -> str:
        """Take an upload whose hash nobody has told; its sha256."""
        self._check_size(0)
        async with self._quota.upload(token) as upload:
            with _no_space_is_507(self._incoming), self._temporary() as file:
                digest, size = await self._drain(body, file, upload)
                await asyncio.to_thread(_flush, file)
                await self._publish(digest, size, Path(file.name), token)
        return digest

    async def collect(self, grace_s: float) -> int:
        """Delete blobs that nothing uses and nobody asked for within the grace period; how many."""
        async with self._database.transaction() as tx:
            await tx.run("recount_uses")
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
        self._disk.require(size)

    async def _drain(self, body: AsyncIterator[bytes], file: IO[bytes], upload: Upload) -> tuple[str, int]:
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
            self._quota.grow(upload, size)
            if held >= WRITE_BYTES:
                self._check_size(size)
                await asyncio.to_thread(write, b"".join(pieces))
                pieces, held = [], 0
        await asyncio.to_thread(write, b"".join(pieces))
        return digest.hexdigest(), size

    async def _publish(self, sha256: str, size: int, file: Path, token: str) -> None:
        """Make the object durable, in place of one that may be there and damaged, and vouch for it."""
        if self._folder is None:
            await self._put(sha256, file)  # before the transaction: a slow bucket must not use up the connections
        async with self._database.transaction() as tx:
            await tx.run("lock_blob", sha256=sha256)
            if self._folder is not None:
                await asyncio.to_thread(_move_durably, file, self._folder / _key(sha256))
            elif await self._version(sha256) is None:  # collected after it was put and before it was locked
                await self._put(sha256, file)
            await tx.run("store_blob", sha256=sha256, size=size, uploader=token)

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


async def hold_blobs(tx: Tx, hashes: Iterable[str]) -> dict[str, int]:
    """The sizes of those blobs that are here and whole; none is collected before the transaction ends."""
    return {row["sha256"]: row["size"] for row in await tx.all("hold_blobs", hashes=sorted(set(hashes)))}


async def require_blobs(tx: Tx, hashes: Iterable[str]) -> list[str]:
    """Those of the hashes that are not here, the others locked against collection until the transaction ends."""
    wanted = sorted(set(hashes))
    here = await hold_blobs(tx, wanted)
    return [sha256 for sha256 in wanted if sha256 not in here]


async def use_blobs(tx: Tx, owner: str, hashes: Iterable[str]) -> None:
    """Keep blobs as long as `owner` uses them."""
    await tx.run("add_blob_uses", owner=owner, hashes=sorted(set(hashes)))


async def drop_blobs(tx: Tx, *owners: str) -> None:
    """`owners` no longer use any blob."""
    await tx.run("drop_blob_uses", owners=list(owners))


def _damaged(sha256: str) -> Damaged:
    return Damaged(
        f"the storage has lost blob {sha256} or damaged it",
        where="storage",
        remedy="Upload the file again, do the task that made it again, or restore the blobs from a backup.",
    )


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
