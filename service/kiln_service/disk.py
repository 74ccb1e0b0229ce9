"""The space that a coordinator keeps free on its disks, so that its database can still write when they are full.

While less than `Limits.reserve_bytes` is free, nothing that grows is taken: uploads and new jobs are refused, workers
get no tasks, and lines of logs are dropped. What ends work or frees space goes on within the reserve: commits,
failures, heartbeats, cancel, archive, garbage collection.
"""

import shutil
from pathlib import Path
from urllib.parse import unquote, urlparse

from kiln_schemas.errors import MachineLacks
from kiln_service.config import ServiceConfig


class Disk:
    """The local folders that a coordinator's data, uploads, blobs and light-field stores are in."""

    def __init__(self, config: ServiceConfig) -> None:
        places = (config.data, config.incoming, local_folder(config.blob_base), local_folder(config.store_base))
        self._folders = list(dict.fromkeys(place for place in places if place is not None))
        self._reserve = config.limits.reserve_bytes

    def shortage(self, size: int = 0) -> MachineLacks | None:
        """The error of a disk that has no room for `size` bytes besides the reserve, if there is one."""
        for folder in self._folders:
            if not folder.exists():
                continue
            free = shutil.disk_usage(folder).free
            if free < size + self._reserve:
                return MachineLacks(
                    f"{free} bytes are free, {size} and a reserve of {self._reserve} are needed",
                    where=str(folder),
                    remedy="Free disk space on the coordinator's machine.",
                )
        return None

    def require(self, size: int = 0) -> None:
        """Raise MachineLacks where `size` bytes would use up the reserve."""
        if (error := self.shortage(size)) is not None:
            raise error


def local_folder(url: str) -> Path | None:
    """The folder of a file:// URL, None for other storage."""
    parts = urlparse(url)
    return Path(unquote(parts.path)) if parts.scheme == "file" else None
