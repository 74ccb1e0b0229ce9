"""Blobs and artifacts in a bucket of a real S3 server, as on a disk: uploads, ranges, collection, restarts, outages."""

import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import obstore
import pytest
import seaweed

from kiln_service.blobs import open_objects
from kiln_service.config import ServiceConfig, Timing

DATA = bytes(range(256)) * 65536  # 16 MiB: more than one part of a multipart upload
SHA256 = hashlib.sha256(DATA).hexdigest()


@dataclass(frozen=True)
class Bucket:
    url: str

    def keys(self) -> list[str]:
        return sorted(entry["path"] for page in obstore.list(open_objects(self.url)) for entry in page)


@pytest.fixture(scope="module")
def server() -> Iterator[seaweed.S3Server]:
    with TemporaryDirectory(prefix="kiln-test-") as folder, seaweed.running(Path(folder)) as running:
        yield running


@pytest.fixture
def bucket(server, monkeypatch, request) -> Bucket:
    for name, value in server.environment().items():
        monkeypatch.setenv(name, value)
    return Bucket(f"s3://{server.bucket}/{request.node.name}")


def test_one_setting_moves_light_fields_and_blobs(tmp_path):
    plain = ServiceConfig(data=tmp_path)
    assert (plain.store_base, plain.blob_base) == (f"file://{tmp_path}/store", f"file://{tmp_path}/blobs")
    moved = ServiceConfig(data=tmp_path, storage_url="s3://bucket/farm/")
    assert (moved.store_base, moved.blob_base) == ("s3://bucket/farm/store", "s3://bucket/farm/blobs")
    split = ServiceConfig(data=tmp_path, storage_url="s3://bucket/farm", store_url="file:///mnt/light")
    assert (split.store_base, split.blob_base) == ("file:///mnt/light", "s3://bucket/farm/blobs")


def test_blobs_and_artifacts(start, bucket, tmp_path):
    with start(storage_url=bucket.url) as home:
        assert home.client.get("/readyz").status_code == 200
        assert home.upload(DATA) == home.upload(DATA) == SHA256
        assert home.upload(b"") == hashlib.sha256(b"").hexdigest()
        assert bucket.keys() == sorted(f"blobs/{name[:2]}/{name}" for name in (SHA256, hashlib.sha256(b"").hexdigest()))
        assert home.client.get(f"/v1/blobs/{SHA256}").content == DATA
        wrong = home.client.put(f"/v1/blobs/{SHA256[::-1]}", content=DATA)
        assert wrong.status_code == 422 and len(bucket.keys()) == 2
        part = home.client.get(f"/v1/blobs/{SHA256}", headers={"Range": "bytes=9999990-10000009"})
        assert part.status_code == 206 and part.content == DATA[9999990:10000010]
        job, worker = home.submit(), home.worker()
        while (claim := worker.claim()) is not None:
            assert claim["payload"]["store_url"] == f"{bucket.url}/store/{job['id']}.zarr"
            worker.finish(claim)
    assert [path.name for path in start.data.iterdir() if path.name not in ("token", "incoming")] == []
    with start(storage_url=bucket.url, data=tmp_path / "other") as home:
        assert home.client.get(f"/v1/blobs/{SHA256}").content == DATA, "another coordinator sees the same"
        path = f"/v1/jobs/{job['id']}/artifacts/lightfield.ktx2"
        assert home.client.get(path).content == b"0123456789" * 100
        assert home.client.get(path, headers={"Range": "bytes=-3"}).content == b"789"


def test_collection(start, bucket, eventually):
    timing = Timing(poll_s=0.1, maintenance_s=0.1, stale_s=600, blob_grace_s=0.5)
    with start(storage_url=bucket.url, timing=timing) as home:
        used = home.submit()["bundle"]["files"]["scene.glb"]
        unused = home.upload(b"nobody wants me")
        eventually(lambda: home.client.get(f"/v1/blobs/{unused}").status_code == 404)
        time.sleep(0.5)
        assert bucket.keys() == [f"blobs/{used[:2]}/{used}"]
        assert home.upload(b"nobody wants me") == unused
        assert home.client.get(f"/v1/blobs/{unused}").content == b"nobody wants me"


def test_a_lost_object_is_a_sentence(start, bucket):
    with start(storage_url=bucket.url) as home:
        sha256 = home.upload(b"soon gone")
        obstore.delete(open_objects(bucket.url), f"blobs/{sha256[:2]}/{sha256}")
        lost = home.client.get(f"/v1/blobs/{sha256}")
        assert lost.status_code == 404 and "has lost" in lost.json()["detail"] and "backup" in lost.json()["remedy"]


def test_a_collection_that_is_cut_off_leaves_no_row_without_its_object(start, bucket, server, monkeypatch, eventually):
    with start(storage_url=bucket.url) as home:
        sha256 = home.upload(b"nobody wants me")
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{seaweed.free_ports(1)[0]}")
    timing = Timing(poll_s=0.1, maintenance_s=0.1, stale_s=600, blob_grace_s=0.3)
    with start(storage_url=bucket.url, timing=timing) as home:
        eventually(lambda: home.sql("SELECT count(*) AS n FROM blobs") == [{"n": 0}])
    monkeypatch.setenv("AWS_ENDPOINT_URL", server.endpoint)
    with start(storage_url=bucket.url) as home:
        assert bucket.keys() == [f"blobs/{sha256[:2]}/{sha256}"], "the object could not be deleted"
        assert home.client.get(f"/v1/blobs/{sha256}").status_code == 404
        assert home.upload(b"nobody wants me") == sha256
        assert home.client.get(f"/v1/blobs/{sha256}").content == b"nobody wants me"


def test_a_server_that_is_away_is_503(start, bucket, monkeypatch):
    with start(storage_url=bucket.url) as home:
        sha256 = home.upload(b"there")
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{seaweed.free_ports(1)[0]}")
    with start(storage_url=bucket.url) as home:
        for reply in (
            home.client.get("/readyz"),
            home.client.get(f"/v1/blobs/{sha256}"),
            home.client.put(f"/v1/blobs/{SHA256}", content=DATA),
        ):
            problem = reply.json()
            assert reply.status_code == 503 and problem["where"] == "storage" and problem["remedy"], problem
        assert home.sql("SELECT sha256 FROM blobs") == [{"sha256": sha256}]
        assert list(home.config.incoming.iterdir()) == []
