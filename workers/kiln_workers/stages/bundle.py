"""A job's bundle as files in a folder."""

from pathlib import Path

from kiln_schemas.tasks import Bundle
from kiln_workers.runner.context import Context


def lay_out(bundle: Bundle, context: Context) -> Path:
    """The folder with the bundle's files; `bundle` was checked, so that every path stays inside."""
    folder = context.scratch / "bundle"
    for path, sha256 in sorted(bundle.files.items()):
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(context.blob(sha256))
    return folder
