"""Opening files that a stranger may have had a hand in: regular ones only, without waiting, never outside a folder.

A path that the user typed is opened as it is, links followed (`open_regular`). A name that a scene, a manifest or a
folder's listing gives is opened below a folder (`open_inside`): links are followed one component at a time, relative
to open descriptors, so what is opened lies in the folder even if somebody exchanges a component meanwhile
(openat(2), O_NOFOLLOW; the walk is that of openat2's RESOLVE_BENEATH, which not every system has). Where files are
written or removed no link is followed at all (`parent_folder`).

Everything here raises OSError, whose `strerror` says what is wrong; `where` and the remedy are the caller's.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Final

MOST_LINKS: Final = 40
"""Links that are followed on the way to one file, as many as Linux follows (path_resolution(7))."""
SMALL_BYTES: Final = 64 << 20
"""Of a manifest, a configuration, a token, a camera."""
_FILE: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_FOLDER: Final = getattr(os, "O_PATH", os.O_RDONLY) | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class NotRegular(OSError):
    """A folder, a pipe, a socket or a device where a file should be."""


class LeavesFolder(OSError):
    """A name or a link that leads out of the folder."""


def open_regular(path: Path) -> BufferedReader:
    """The file at `path`, links followed; a pipe is refused at once and never waited for."""
    try:
        return _checked(os.open(path, _FILE), path)
    except ValueError as error:  # a NUL, or half of a surrogate pair
        raise OSError(errno.EINVAL, "this is not a file name", str(path)) from error


def read_small(path: Path, most: int = SMALL_BYTES) -> bytes:
    """The bytes of a regular file of at most `most` bytes."""
    with open_regular(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it has more than {most} bytes", str(path))
    return data


def open_inside(folder: Path, name: str) -> BufferedReader:
    """The regular file `name` (parts between slashes) below `folder`; links are followed as long as they stay there."""
    walk = [os.open(folder, _FOLDER & ~os.O_NOFOLLOW)]
    parts = list(reversed(name.split("/")))
    links = 0
    try:
        while parts:
            part = parts.pop()
            if part in ("", "."):
                continue
            if part == "..":
                if len(walk) == 1:
                    raise LeavesFolder(errno.EXDEV, "it lies outside the folder", name)
                os.close(walk.pop())
                continue
            try:
                target = os.readlink(part, dir_fd=walk[-1])
            except OSError as error:
                if error.errno != errno.EINVAL:  # EINVAL: it is no link
                    raise
            else:
                links += 1
                if links > MOST_LINKS:
                    raise OSError(errno.ELOOP, "there are too many links", name)
                if target.startswith("/"):
                    target = _below(folder, target, name)
                    while len(walk) > 1:
                        os.close(walk.pop())
                parts += reversed(target.split("/"))
                continue
            if not parts:
                return _checked(os.open(part, _FILE | os.O_NOFOLLOW, dir_fd=walk[-1]), folder / name)
            walk.append(os.open(part, _FOLDER, dir_fd=walk[-1]))
        raise NotRegular(errno.EISDIR, "it is a folder", name)
    except ValueError as error:
        raise OSError(errno.EINVAL, "this is not a file name", name) from error
    finally:
        for handle in walk:
            os.close(handle)


def is_inside(folder: Path, name: str) -> bool:
    """Whether `open_inside` opens it, or refuses it for where it leads; False where there is nothing."""
    try:
        open_inside(folder, name).close()
    except LeavesFolder:
        return True
    except OSError:
        return False
    return True


@contextmanager
def parent_folder(folder: Path, name: str, *, make: bool = False) -> Iterator[tuple[int, str]]:
    """A descriptor of the folder in which `name` lies below `folder`, and its last part, to write or remove it there.

    No link is followed below `folder`: LeavesFolder. With `make` folders are made where they are missing.
    """
    *parents, last = name.split("/")
    if last in ("", ".", "..") or ".." in parents:
        raise LeavesFolder(errno.EXDEV, "it lies outside the folder", name)
    handle = os.open(folder, _FOLDER & ~os.O_NOFOLLOW)
    try:
        for part in parents:
            if make:
                with suppress(FileExistsError):
                    os.mkdir(part, dir_fd=handle)
            try:
                inner = os.open(part, _FOLDER, dir_fd=handle)
            except OSError as error:
                if error.errno in (errno.ELOOP, errno.ENOTDIR) and _is_link(part, handle):
                    raise LeavesFolder(errno.EXDEV, f"'{part}' in it is a link", str(folder / name)) from None
                raise
            os.close(handle)
            handle = inner
        yield handle, last
    finally:
        os.close(handle)


def _below(folder: Path, target: str, name: str) -> str:
    """An absolute link's target as a name below the folder, from which the walk begins anew."""
    root = os.path.realpath(folder).rstrip("/") + "/"
    if not target.startswith(root):
        raise LeavesFolder(errno.EXDEV, "it is a link that leaves the folder", name)
    return target.removeprefix(root)


def _is_link(part: str, handle: int) -> bool:
    return stat.S_ISLNK(os.stat(part, dir_fd=handle, follow_symlinks=False).st_mode)


def _checked(handle: int, path: Path) -> BufferedReader:
    """The open descriptor as a file, closed where it is not a regular one."""
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise NotRegular(errno.EINVAL, "it is not a regular file", str(path))
        os.set_blocking(handle, True)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise
