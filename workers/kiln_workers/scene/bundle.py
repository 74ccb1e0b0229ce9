"""Files of a scene bundle, opened by the relative names that scene files use, never outside the bundle's folder.

A scene comes from a stranger, so each name in it is a claim to be checked: it is resolved relative to the file that
names it, held to `kiln_schemas.job.check_bundle_path`, and the file found must still lie in the folder after symbolic
links are followed.
"""

import posixpath
from dataclasses import dataclass
from pathlib import Path

from kiln_schemas.errors import InputError
from kiln_schemas.job import check_bundle_path
from kiln_workers.scene.limits import MAX_FILE_BYTES, check_count


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
            raise InputError(f"the file name {error.detail}", where=self.origin, remedy=error.remedy) from None

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

    def read(self, reference: str, what: str = "file", most: int = MAX_FILE_BYTES) -> bytes:
        """The bytes of the file that `reference` stands for; TooLarge where there are more than `most`."""
        path = self.path(reference, what)
        check_count(path.stat().st_size, most, "bytes", self.name(reference), "Split it, or save it in binary form.")
        return path.read_bytes()
