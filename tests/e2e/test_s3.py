"""A farm whose light fields and blobs are in a bucket makes the package that a bake on one machine makes."""

import json
from pathlib import Path

import obstore
import pytest
import seaweed
from e2e_farm import Farm, digests, lightkiln, settings

from kiln_service.blobs import open_objects


def test_a_farm_on_a_bucket(
    s3_server: seaweed.S3Server,
    room_files: tuple[Path, Path],
    baked: Path,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in s3_server.environment().items():
        monkeypatch.setenv(name, value)
    farm = Farm(folder / "farm")
    farm.folder.mkdir()
    try:
        storage = f"s3://{s3_server.bucket}/farm"
        farm.start_coordinator("--storage", storage)
        farm.start_worker("first", "--kinds", "prepare,render", "--threads", "1")
        farm.start_worker("second", "--kinds", "fit,refine,package", "--threads", "1")
        job = farm.submit(*room_files, *settings())
        farm.finish(job)
        package = farm.download(job, folder / "package")
        at = ("--url", farm.url, "--token", farm.token)
        assert lightkiln("archive", job, *at).returncode == 0
        freed = json.loads(lightkiln("gc", *at, "--json").stdout)
        again = json.loads(lightkiln("gc", *at, "--json").stdout)
    finally:
        farm.stop()
    assert digests(package) == digests(baked)
    data = {path.name for path in (farm.folder / "data").iterdir()}
    assert data == {"incoming", "lock", "postgres", "postgres.log", "token"}, (
        "nothing else is on the coordinator's disk"
    )
    assert freed["jobs"][0]["stores"] == [f"{storage}/store/{job}.zarr"] and again["jobs"] == []
    bucket = open_objects(storage)
    left = [entry["path"] for page in obstore.list(bucket) for entry in page]
    assert left and all(path.startswith("blobs/") for path in left)
    stored = {path.rpartition("/")[2] for path in left}
    assert set(digests(package).values()) <= stored, "what was downloaded lies in the bucket"
