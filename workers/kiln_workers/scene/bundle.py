"""Files of a scene bundle, opened by the relative names that scene files use, never outside the bundle's folder.

A scene comes from a stranger, so each name in it is a claim to be checked: it is resolved relative to the file that
names it, held to `kiln_schemas.job.check_bundle_path`, and opened by a walk that no link leads out of the folder
(`kiln_schemas.files`).
"""

import os
import posixpath
from dataclasses import dataclass
from pathlib import Path

from kiln_schemas.errors import InputError
from kiln_schemas.files import LeavesFolder, NotRegular, is_inside, open_inside
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

    def holds(self, reference: str) -> bool:
        """Whether there is a file (or a link that leaves the folder, which `read` refuses)."""
        return is_inside(self.folder, self.name(reference))

    def read(self, reference: str, what: str = "file", most: int = MAX_FILE_BYTES) -> bytes:
        """The bytes of the file that `reference` stands for; TooLarge where there are more than `most`."""
        name = self.name(reference)
        try:
            with open_inside(self.folder, name) as file:
                size = os.fstat(file.fileno()).st_size
                check_count(size, most, "bytes", name, "Split it, or save it in binary form.")
                return file.read(most)
        except LeavesFolder:
            detail, remedy = f"'{name}' is a link that leaves the bundle", "Put the file itself there."
        except (FileNotFoundError, NotADirectoryError, NotRegular):
            detail, remedy = f"the {what} '{name}' is missing", "Add it to the bundle or remove its use."
        except OSError as error:
            detail, remedy = f"the {what} '{name}' cannot be read: {error.strerror}", "Make it readable."
        raise InputError(detail, where=self.origin, remedy=remedy)
