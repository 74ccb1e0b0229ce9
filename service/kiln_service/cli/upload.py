"""Send a bundle: only the files that the coordinator lacks, with a bar, then the job."""

from functools import partial
from pathlib import Path
from uuid import uuid4

from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

from kiln_schemas.client import Client
from kiln_schemas.job import JobRequest, JobView
from kiln_service.cli.bundle import LocalBundle
from kiln_service.cli.output import notices


def upload_and_submit(
    api: Client, local: LocalBundle, request: JobRequest, *, key: str | None = None, bar: bool = True
) -> JobView:
    """Upload what is missing, with a bar on a terminal if `bar`, and submit under an `Idempotency-Key`.

    Without `key` one of its own is made, so that a request whose answer was lost makes no second job.
    """
    files = local.by_hash()
    missing = api.missing(files)
    columns = (TextColumn("uploading"), BarColumn(), DownloadColumn())
    with Progress(*columns, console=notices, transient=True, disable=not (bar and notices.is_terminal)) as shown:
        row = shown.add_task("uploading", total=sum(_size(files[sha256]) for sha256 in missing))
        for sha256 in missing:
            api.put_blob(sha256, partial(local.open, sha256), lambda size: shown.advance(row, size))
    return api.submit(request, key or uuid4().hex)


def _size(path: Path) -> int:
    """Bytes of a file for the bar; what is wrong with the file is told when it is opened."""
    try:
        return path.stat().st_size
    except OSError:
        return 0
