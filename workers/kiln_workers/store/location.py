"""Where a store lives: `file://` and `s3://` URLs as tensorstore key-value stores, and its errors as ours.

S3 credentials, region and endpoint come from the standard AWS_* environment variables, so a URL holds no secret.
tensorstore reports every failure as ValueError whose text starts with an absl status; this module is the edge at
which those become `kiln_schemas.errors`.
"""

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from kiln_schemas.errors import Conflict, InputError, KilnError, MachineLacks

log = logging.getLogger(__name__)

FULL_PATIENCE_S: Final = 60.0
"""A full disk is tried again for so long: all of a farm's attempts at a task would otherwise end in seconds."""
PAUSE_S: Final = (0.5, 5.0)
"""First and longest pause between two tries."""
_DAMAGE = ("DATA_LOSS", "FAILED_PRECONDITION", "INVALID_ARGUMENT", "OUT_OF_RANGE", "NOT_FOUND")
_PASSING = ("No space left", "Disk quota")
"""What ends when somebody frees space; a file's greatest size, for one, does not."""
_DISK = ("No space left", "File too large", "Disk quota", "RESOURCE_EXHAUSTED")
_DENIED = ("PERMISSION_DENIED", "Permission denied", "Read-only file system", "AccessDenied", "InvalidAccessKeyId")


def kvstore_spec(url: str) -> dict[str, Any]:
    """The tensorstore key-value store of a folder URL; InputError where it is neither file:// nor s3://."""
    parts = urlsplit(url)
    path = unquote(parts.path).strip("/")
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and path:
        return {"driver": "file", "path": f"/{path}/"}
    if parts.scheme == "s3" and parts.netloc:
        return _s3_spec(parts.netloc, path)
    raise InputError(
        f"'{url}' is not a place for a store", where="store_url", remedy="Use file:///DIR or s3://BUCKET/PREFIX."
    )


def _s3_spec(bucket: str, prefix: str) -> dict[str, Any]:
    spec: dict[str, Any] = {"driver": "s3", "bucket": bucket, "path": f"{prefix}/" if prefix else ""}
    if endpoint := os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL"):
        spec["endpoint"] = endpoint.rstrip("/")
    if region := os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION"):
        spec["aws_region"] = region
    if os.environ.get("AWS_ACCESS_KEY_ID"):
        spec["aws_credentials"] = {"type": "environment"}
    elif "endpoint" in spec:
        spec["aws_credentials"] = {"type": "anonymous"}
    spec["context"] = {"s3_request_retries": {"max_retries": 8, "max_delay": "4s"}}
    return spec


@contextmanager
def translated_errors(url: str) -> Iterator[None]:
    """Turn tensorstore's errors into ours; the place named is the store's URL."""
    try:
        yield
    except (ValueError, OSError, NotImplementedError) as error:
        raise _translate(url, str(error)) from error


def translated(url: str, error: Exception) -> KilnError:
    """tensorstore's error as ours; the place named is the store's URL."""
    return _translate(url, str(error))


def is_damage(error: Exception) -> bool:
    """Whether a failed read or opening means that what lies there is gone, cut off or has wrong bytes."""
    return str(error).startswith(_DAMAGE) and not any(sign in str(error) for sign in (*_DISK, *_DENIED))


def is_difference(error: Exception) -> bool:
    """Whether an array lies there that is whole, but another one."""
    return "Expected" in str(error) and "but received" in str(error) and "Error parsing" not in str(error)


def first_words(error: Exception) -> str:
    """What tensorstore says, without where in its source it says so."""
    return str(error).split(" [tensorstore_spec", maxsplit=1)[0].split(" [source locations", maxsplit=1)[0]


def write_patiently(url: str, write: Callable[[], object]) -> None:
    """Call `write`, which may be repeated, until the disk of the store has space for it or the patience is over."""
    deadline, pause = time.monotonic() + FULL_PATIENCE_S, PAUSE_S[0]
    while True:
        try:
            with translated_errors(url):
                write()
            return
        except MachineLacks as error:
            if time.monotonic() > deadline or not any(sign in error.detail for sign in _PASSING):
                raise
            log.warning("%s; trying again", error.detail)
        time.sleep(pause)
        pause = min(2 * pause, PAUSE_S[1])


def _translate(url: str, text: str) -> KilnError:
    cause = first_words(ValueError(text))
    if any(sign in text for sign in _DISK):
        return MachineLacks(
            f"the store cannot take more data ({cause})",
            where=url,
            remedy="Free space (or raise the quota) there, or choose another folder for the data.",
        )
    if any(sign in text for sign in _DENIED):
        return MachineLacks(
            f"the store refuses access ({cause})",
            where=url,
            remedy="Give this user the right to write there, or check the AWS_* credentials.",
        )
    if text.startswith("FAILED_PRECONDITION"):
        return Conflict(
            f"another store lies there ({cause})", where=url, remedy="Choose an empty folder, or remove that store."
        )
    if text.startswith("DATA_LOSS"):
        return MachineLacks(
            f"stored data are damaged ({cause})",
            where=url,
            remedy="Check the disk, then render the tile again.",
        )
    return MachineLacks(
        f"the store does not work ({cause})", where=url, remedy="Check that the place exists and answers."
    )
