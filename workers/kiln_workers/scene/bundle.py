"""Files of a scene bundle, opened by the relative names that scene files use, never outside the bundle's folder.

A scene comes from a stranger, so each name in it is a claim to be checked: it is resolved relative to the file that
names it, held to `kiln_schemas.job.check_bundle_path`, and the file found must still lie in the folder after symbolic
links are followed.
"""

import posixpath
from dataclasses import dataclass
from pathlib import Path

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.job import check_bundle_path

MAX_FILE_BYTES = 4 << 30


@dataclass(frozen=True)
class BundleFolder:
    """A folder and the file in it (`origin`) that names others."""

    folder: Path
    origin: str

    def name(self, reference: str) -> str:
        """The bundle path of `reference` as written in `origin`; InputError where it leaves the bundle."""
        joined = posixpath.join(posixpath.dirname(self.origin), reference)
        try:
            if "\\" in reference or "\0" in reference:
                check_bundle_path(reference)
            return check_bundle_path(posixpath.normpath(joined))
        except InputError as error:
            raise InputError(
                f"the file name '{reference}' leaves the bundle", where=self.origin, remedy=error.remedy
            ) from None

    def path(self, reference: str, what: str = "file") -> Path:
        """The existing file that `reference` stands for."""
        name = self.name(reference)
        found = (self.folder / name).resolve()
        if not found.is_relative_to(self.folder.resolve()):
            raise InputError(
                f"'{reference}' is a link that leaves the bundle",
                where=self.origin,
                remedy="Put the file itself there.",
            )
        if not found.is_file():
            raise InputError(
                f"the {what} '{name}' is missing", where=self.origin, remedy="Add it to the bundle or remove its use."
            )
        return found

    def read(self, reference: str, what: str = "file") -> bytes:
        """The bytes of the file that `reference` stands for."""
        path = self.path(reference, what)
        if path.stat().st_size > MAX_FILE_BYTES:
            raise TooLarge(f"the {what} '{reference}' has more than {MAX_FILE_BYTES} bytes", where=self.origin)
        return path.read_bytes()
