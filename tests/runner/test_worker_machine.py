"""Sizes, folders, the blob cache: what a worker owns on its machine."""

import hashlib
import os
from pathlib import Path

import pytest

from kiln_schemas.errors import InputError, MachineLacks
from kiln_workers.runner.blobs import BlobCache
from kiln_workers.runner.machine import claim_folder, cores, default_memory_bytes, memory_bytes, parse_size


class Source:
    """Blobs of known content, and which were asked for."""

    def __init__(self, *contents: bytes) -> None:
        self.known = {hashlib.sha256(data).hexdigest(): data for data in contents}
        self.asked: list[bytes] = []

    @property
    def hashes(self) -> list[str]:
        return list(self.known)

    def fetch(self, sha256: str, target: Path) -> None:
        self.asked.append(self.known[sha256])
        target.write_bytes(self.known[sha256])


@pytest.mark.parametrize(
    ("text", "size"),
    [("4GiB", 4 << 30), ("500MB", 500_000_000), ("1.5 KiB", 1536), ("77", 77), ("2G", 2 << 30), ("3B", 3)],
)
def test_sizes(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "GiB", "-1GiB", "0", "4 parsecs", "1e9", "4GiB!"])
def test_sizes_that_are_none(text: str) -> None:
    with pytest.raises(InputError, match="--memory"):
        parse_size(text)


def test_the_share_is_of_this_machine() -> None:
    assert 1 <= cores() <= (os.cpu_count() or 1)
    assert 0 < default_memory_bytes() < memory_bytes()


def test_workers_have_folders_of_their_own_and_reuse_those_of_the_dead(tmp_path: Path) -> None:
    first, first_lock = claim_folder(tmp_path)
    second, second_lock = claim_folder(tmp_path)
    with second_lock:
        assert first != second
        first_lock.close()
        again, again_lock = claim_folder(tmp_path)
        again_lock.close()
        assert again == first


def test_a_folder_that_cannot_be_made_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MachineLacks, match="--scratch"):
        claim_folder(tmp_path / "file" / "below")


def test_the_cache_evicts_what_was_used_longest_ago(tmp_path: Path) -> None:
    source = Source(b"a" * 100, b"b" * 100, b"c" * 100)
    a, b, c = source.hashes
    cache = BlobCache(tmp_path / "cache", 250, source.fetch)
    for moment, sha256 in enumerate((a, b, a)):
        os.utime(cache.get(sha256), (moment, moment))
    cache.get(c)
    assert {path.name for path in cache.folder.iterdir()} == {a, c}
    assert len(source.asked) == 3


def test_a_blob_larger_than_the_cache_is_served_all_the_same(tmp_path: Path) -> None:
    source = Source(b"x" * 1000)
    cache = BlobCache(tmp_path / "cache", 10, source.fetch)
    assert cache.get(source.hashes[0]).read_bytes() == b"x" * 1000


def test_a_damaged_file_of_the_cache_is_fetched_again(tmp_path: Path) -> None:
    source = Source(b"scene")
    cache = BlobCache(tmp_path / "cache", 1 << 20, source.fetch)
    cache.get(source.hashes[0]).write_bytes(b"scenf")
    assert cache.get(source.hashes[0]).read_bytes() == b"scene" and len(source.asked) == 2


def test_a_linked_blob_outlives_its_eviction(tmp_path: Path) -> None:
    source = Source(b"first" * 10, b"second" * 10)
    cache = BlobCache(tmp_path / "cache", 60, source.fetch)
    linked = cache.link(source.hashes[0], tmp_path / "linked")
    os.utime(cache.get(source.hashes[0]), (0, 0))
    cache.get(source.hashes[1])
    assert [path.name for path in cache.folder.iterdir()] == [source.hashes[1]]
    assert linked.read_bytes() == b"first" * 10


def test_a_folder_that_others_may_have_made_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Links and another user's folder under the temporary folder; an open one of ours is closed."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    base, elsewhere = tmp_path / f"lightkiln-worker-{os.getuid()}", tmp_path / "elsewhere"
    elsewhere.mkdir()
    base.symlink_to(elsewhere)
    with pytest.raises(MachineLacks, match=r"is a link.*--scratch"):
        claim_folder()
    assert list(elsewhere.iterdir()) == []
    base.unlink()
    base.mkdir(mode=0o777)
    base.chmod(0o777)
    folder, lock = claim_folder()
    lock.close()
    assert {path.stat().st_mode & 0o777 for path in (base, folder)} == {0o700}
    folder.rmdir()
    folder.symlink_to(elsewhere)
    with pytest.raises(MachineLacks, match="is a link"):
        claim_folder()
    folder.unlink()
    (base / "0.lock").unlink()
    (base / "0.lock").symlink_to(elsewhere / "made")
    with pytest.raises(MachineLacks, match="cannot be made"):
        claim_folder()
    assert list(elsewhere.iterdir()) == []


@pytest.mark.skipif(os.getuid() != 0, reason="only root makes another user's folder")
def test_a_folder_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    base = tmp_path / f"lightkiln-worker-{os.getuid()}"
    base.mkdir(mode=0o700)
    os.chown(base, 12345, 12345)
    with pytest.raises(MachineLacks, match="owned by user 12345, not by 0"):
        claim_folder()
    with pytest.raises(MachineLacks, match="owned by user 12345"):
        BlobCache(base, 100, Source().fetch)
    assert list(base.iterdir()) == []


def test_the_cache_follows_no_links(tmp_path: Path) -> None:
    """A link in place of a blob is replaced, whatever it leads to; other links are neither counted nor removed."""
    source = Source(b"a" * 100, b"b" * 100)
    outside = tmp_path / "outside"
    outside.write_bytes(b"a" * 100)
    cache = BlobCache(tmp_path / "cache", 150, source.fetch)
    (cache.folder / source.hashes[0]).symlink_to(outside)
    (cache.folder / "other").symlink_to(outside)
    assert not cache.get(source.hashes[0]).is_symlink() and source.asked == [b"a" * 100]
    os.utime(cache.folder / source.hashes[0], (0, 0))
    cache.get(source.hashes[1])
    assert {path.name for path in cache.folder.iterdir()} == {source.hashes[1], "other"}
    assert outside.read_bytes() == b"a" * 100
