"""Downloads: a folder with a manifest is whole, whatever happens on the way."""

import hashlib
import json
from pathlib import Path

import pytest

from kiln_schemas.conventions import MANIFEST_JSON
from kiln_schemas.errors import Conflict, InputError, Unreachable
from kiln_schemas.tasks import Artifact
from kiln_service.cli.fetch import download_package


class Shelf:
    """A finished job's artifacts, from memory; goes away after `limit` downloads."""

    def __init__(self, files: dict[str, bytes], limit: int = 1000) -> None:
        names = json.dumps({"files": [{"name": name} for name in files]}).encode()
        self.files, self.limit, self.served = files | {MANIFEST_JSON: names}, limit, list[str]()

    def artifacts(self, job_id: str) -> tuple[Artifact, ...]:
        return tuple(
            Artifact(name=name, sha256=hashlib.sha256(data).hexdigest(), size=len(data), media_type="x/y")
            for name, data in self.files.items()
        )

    def download(self, job_id: str, artifact: Artifact, target: Path, on_bytes) -> None:
        if len(self.served) == self.limit:
            raise Unreachable("gone")
        self.served.append(artifact.name)
        target.write_bytes(self.files[artifact.name])
        on_bytes(artifact.size)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_package_arrives_whole_with_the_manifest_last(tmp_path: Path) -> None:
    shelf = Shelf({"a.ktx2": b"a", "shaders/b.glsl": b"b"})
    files = download_package(shelf, "job", tmp_path / "out")
    assert contents(tmp_path / "out") == shelf.files
    assert files[-1].name == MANIFEST_JSON and not (tmp_path / "out.partial").exists()


def test_an_interrupted_download_leaves_the_old_package_and_is_continued(tmp_path: Path) -> None:
    old = Shelf({"a.ktx2": b"old a", "gone.ktx2": b"old"})
    download_package(old, "job", tmp_path / "out")
    (tmp_path / "out" / "mine.txt").write_text("the user's own")
    shelf = Shelf({"a.ktx2": b"new a", "b.ktx2": b"new b"}, limit=2)
    with pytest.raises(Unreachable):
        download_package(shelf, "job", tmp_path / "out", force=True)
    assert contents(tmp_path / "out") == old.files | {"mine.txt": b"the user's own"}
    shelf.limit = 1000
    download_package(shelf, "job", tmp_path / "out", force=True)
    assert contents(tmp_path / "out") == shelf.files | {"mine.txt": b"the user's own"}
    assert len(shelf.served) == len(shelf.files)


def test_a_package_is_not_replaced_unasked(tmp_path: Path) -> None:
    download_package(Shelf({"a": b"a"}), "job", tmp_path / "out")
    with pytest.raises(Conflict, match="--force"):
        download_package(Shelf({"a": b"b"}), "job", tmp_path / "out")
    assert (tmp_path / "out" / "a").read_bytes() == b"a"


def test_a_foreign_manifest_is_not_trusted_to_name_files_to_remove(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("x")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / MANIFEST_JSON).write_text(json.dumps({"files": [{"name": "../precious"}]}))
    with pytest.raises(InputError):
        download_package(Shelf({"a": b"a"}), "job", tmp_path / "out", force=True)
    assert (tmp_path / "precious").exists()


def test_a_job_without_a_manifest_has_no_package(tmp_path: Path) -> None:
    shelf = Shelf({})
    shelf.files.clear()
    with pytest.raises(InputError, match="no package"):
        download_package(shelf, "job", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_target_that_cannot_be_written_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        download_package(Shelf({"a": b"a"}), "job", tmp_path / "file" / "out")
