"""How much a token may have stored that no job uses: what it uploads counts until a job uses it or it is collected."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from kiln_schemas.errors import QuotaExceeded
from kiln_service.config import Limits
from kiln_service.db import Database


@dataclass(eq=False)
class Upload:
    """An upload that has begun, and what its token had stored without use at that time."""

    token: str
    blobs: int
    stored: int
    size: int = 0


class Quota:
    """The quotas of all tokens; uploads that have begun count with the bytes that have arrived."""

    def __init__(self, database: Database, limits: Limits) -> None:
        self._database, self._limits = database, limits
        self._open: dict[str, list[Upload]] = {}

    @asynccontextmanager
    async def upload(self, token: str) -> AsyncIterator[Upload]:
        """Count an upload for the time of the block; QuotaExceeded where the token has stored too many blobs."""
        row = await self._database.first("unused_of_token", token=token)
        assert row is not None
        upload = Upload(token, int(row["blobs"]), int(row["bytes"]))
        others = self._open.setdefault(token, [])
        others.append(upload)
        try:
            self.grow(upload, 0)
            yield upload
            for other in others:
                other.blobs, other.stored = other.blobs + 1, other.stored + upload.size
        finally:
            others.remove(upload)
            if not others:
                self._open.pop(token, None)

    def grow(self, upload: Upload, size: int) -> None:
        """The upload has, or will have, `size` bytes; QuotaExceeded where that is too much."""
        upload.size = max(size, upload.size)
        underway = self._open[upload.token]
        blobs, total = upload.blobs + len(underway), upload.stored + sum(other.size for other in underway)
        for use, limit, unit in (
            (blobs, self._limits.unused_blobs, "blobs"),
            (total, self._limits.unused_bytes, "bytes"),
        ):
            if use > limit:
                raise QuotaExceeded(
                    f"with this upload the token '{upload.token}' would have stored {use} {unit} that no job uses; "
                    f"{limit} are allowed",
                    where=f"limits.unused_{unit}",
                    remedy="Submit the job that needs them, wait until unused blobs are collected (an hour after their "
                    "upload), or raise the limit in the coordinator's configuration.",
                )
