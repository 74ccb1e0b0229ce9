"""Downloads: a folder with a manifest is whole, whatever happens on the way."""

import hashlib
import json
import os
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from kiln_schemas.client import Client
from kiln_schemas.conventions import MANIFEST_JSON
from kiln_schemas.errors import Conflict, DamagedDownload, InputError, Unreachable
from kiln_schemas.tasks import Artifact
from kiln_service.cli.fetch import damaged_files, download_package, remove_package


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


@pytest.fixture
def linked(tmp_path: Path) -> Path:
    """A package in which somebody replaced a folder by a link to a folder of his own."""
    shelf = Shelf({"a.ktx2": b"a", "shaders/b.glsl": b"b"})
    download_package(shelf, "job", tmp_path / "out")
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "b.glsl").write_bytes(b"precious")
    shutil.rmtree(tmp_path / "out" / "shaders")
    (tmp_path / "out" / "shaders").symlink_to(precious)
    return tmp_path


def test_a_replaced_package_is_not_removed_through_a_link(linked: Path) -> None:
    with pytest.raises(InputError, match="link"):
        download_package(Shelf({"a.ktx2": b"new"}), "job", linked / "out", force=True)
    assert (linked / "precious" / "b.glsl").read_bytes() == b"precious"
    assert (linked / "out" / "a.ktx2").read_bytes() == b"a" and (linked / "out" / MANIFEST_JSON).is_file()


def test_nothing_is_written_through_a_link(linked: Path) -> None:
    (linked / "out" / MANIFEST_JSON).write_text('{"files": [{"name": "a.ktx2"}]}')
    with pytest.raises(InputError, match="link"):
        download_package(Shelf({"shaders/b.glsl": b"new"}), "job", linked / "out", force=True)
    assert (linked / "precious" / "b.glsl").read_bytes() == b"precious"


@pytest.mark.parametrize("where", ["out.partial", "out.partial/shaders", "out.partial/a.ktx2"])
def test_nothing_arrives_through_a_link(tmp_path: Path, where: str) -> None:
    precious = tmp_path / "precious"
    (precious if where != "out.partial/a.ktx2" else tmp_path).mkdir(exist_ok=True)
    link = tmp_path / where
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(precious)
    with pytest.raises((InputError, OSError), match="link"):
        download_package(Serving({"a.ktx2": b"a", "shaders/b.glsl": b"b"}), "job", tmp_path / "out")
    assert not precious.exists() or not list(precious.iterdir())


def test_a_file_that_is_itself_a_link_is_replaced_and_its_target_kept(tmp_path: Path) -> None:
    download_package(Shelf({"a.ktx2": b"a"}), "job", tmp_path / "out")
    (tmp_path / "precious").write_bytes(b"precious")
    (tmp_path / "out" / "a.ktx2").unlink()
    (tmp_path / "out" / "a.ktx2").symlink_to("../precious")
    download_package(Shelf({"a.ktx2": b"new"}), "job", tmp_path / "out", force=True)
    assert (tmp_path / "precious").read_bytes() == b"precious"
    assert not (tmp_path / "out" / "a.ktx2").is_symlink() and (tmp_path / "out" / "a.ktx2").read_bytes() == b"new"


NO_MANIFESTS = [
    b"",
    b"[]",
    b"{}",
    b'{"files": 5}',
    b'{"files": [5]}',
    b'{"files": [{"name": 5}]}',
    b'{"files": [{"name": null, "sha256": 5}]}',
    b"\xff\xfe",
    b"[" * 100_000,
    b'{"files": ' + b'[{"name": ' * 50_000,
    b'{"files": [{"name": ' + b"9" * 10_000 + b"}]}",
]


@pytest.mark.parametrize("data", NO_MANIFESTS, ids=range(len(NO_MANIFESTS)))
def test_what_is_no_manifest_is_a_sentence(tmp_path: Path, data: bytes) -> None:
    (tmp_path / MANIFEST_JSON).write_bytes(data)
    with pytest.raises(InputError, match="not a manifest that lightkiln wrote"):
        damaged_files(tmp_path)
    with pytest.raises(Conflict, match="not a manifest that lightkiln wrote"):
        remove_package(tmp_path)
    assert (tmp_path / MANIFEST_JSON).read_bytes() == data


def test_verifying_waits_for_no_pipe(tmp_path: Path) -> None:
    download_package(Shelf({"a": b"a", "b": b"b"}), "job", tmp_path / "out")
    shelf = Shelf({"a": b"a", "b": b"b"})
    entries = [artifact.model_dump() for artifact in shelf.artifacts("job") if artifact.name != MANIFEST_JSON]
    (tmp_path / "out" / MANIFEST_JSON).write_text(json.dumps({"files": entries}))
    assert damaged_files(tmp_path / "out") == (2, [])
    (tmp_path / "out" / "b").unlink()
    os.mkfifo(tmp_path / "out" / "b")
    assert damaged_files(tmp_path / "out") == (2, ["b"])
    (tmp_path / "out" / MANIFEST_JSON).unlink()
    os.mkfifo(tmp_path / "out" / MANIFEST_JSON)
    with pytest.raises(InputError, match="not a regular file"):
        damaged_files(tmp_path / "out")


class Serving(Shelf):
    """The same over HTTP by the real client; `damage` so many answers first."""

    damage = 0

    def download(self, job_id: str, artifact: Artifact, target: Path, on_bytes) -> None:
        shelf = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                data = shelf.files[artifact.name]
                if shelf.damage > 0:
                    shelf.damage -= 1
                    data = bytes(len(data))
                self.send_response(200)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: object) -> None:
                pass

        with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            try:
                with Client(f"http://127.0.0.1:{server.server_port}", "token", patience_s=0) as client:
                    client.download(job_id, artifact, target, on_bytes)
            finally:
                server.shutdown()
                thread.join()


@pytest.mark.parametrize("damaged", [1, 2])
def test_a_damaged_download_is_tried_once_more_and_named_with_both_hashes(tmp_path: Path, damaged: int) -> None:
    shelf = Serving({"a.ktx2": b"good"})
    shelf.damage = damaged
    if damaged == 1:
        download_package(shelf, "job", tmp_path / "out")
        assert contents(tmp_path / "out") == shelf.files
        return
    with pytest.raises(DamagedDownload) as caught:
        download_package(shelf, "job", tmp_path / "out")
    for word in ("a.ktx2", hashlib.sha256(b"good").hexdigest(), hashlib.sha256(bytes(4)).hexdigest()):
        assert word in str(caught.value)
    assert caught.value.exit_code == 3 and not (tmp_path / "out").exists()


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
