"""Blobs whose bytes a disk or a bucket damaged: found when they are read, and made again by whoever can."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import obstore
import pytest
import seaweed

from kiln_service.blobs import open_objects

DATA = bytes(range(256)) * 12289  # a little more than 3 MiB: several pieces, the last one short
SHA256 = hashlib.sha256(DATA).hexdigest()


@pytest.fixture(scope="module")
def server() -> Iterator[seaweed.S3Server]:
    with TemporaryDirectory(prefix="kiln-test-") as folder, seaweed.running(Path(folder)) as running:
        yield running


@dataclass(frozen=True)
class Place:
    """A coordinator whose blobs are on a disk or in a bucket, and the means to damage them there."""

    home: Any
    url: str

    def damage(self, sha256: str, how: Callable[[bytes], bytes] | None) -> None:
        """Rewrite the object behind the coordinator's back, or delete it."""
        objects, key = open_objects(self.url), f"{sha256[:2]}/{sha256}"
        if how is None:
            obstore.delete(objects, key)
        else:
            obstore.put(objects, key, how(bytes(obstore.get(objects, key).bytes())))

    def stored(self, sha256: str) -> bytes:
        return bytes(obstore.get(open_objects(self.url), f"{sha256[:2]}/{sha256}").bytes())


@pytest.fixture(params=["disk", "bucket"])
def place(request, start, monkeypatch) -> Iterator[Place]:
    if request.param == "disk":
        with start() as home:
            yield Place(home, home.config.blob_base)
        return
    for name, value in request.getfixturevalue("server").environment().items():
        monkeypatch.setenv(name, value)
    url = f"s3://{seaweed.BUCKET}/{hashlib.sha256(request.node.name.encode()).hexdigest()[:12]}"
    with start(blob_url=url) as home:
        yield Place(home, url)


def flipped(data: bytes) -> bytes:
    """One bit of a byte in the middle is wrong."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def cut(data: bytes) -> bytes:
    """The second half is gone."""
    return data[: len(data) // 2]


def read(home: Any, sha256: str) -> httpx.Response:
    """What a client gets that asks again where an answer breaks off."""
    for _ in range(3):
        try:
            return home.client.get(f"/v1/blobs/{sha256}")
        except httpx.RemoteProtocolError:
            continue
    raise AssertionError("every answer broke off")


HOW = [pytest.param(flipped, id="flipped"), pytest.param(cut, id="cut"), pytest.param(None, id="gone")]


@pytest.mark.parametrize("how", HOW)
def test_damaged_bytes_are_never_whole_and_an_upload_replaces_them(place, how):
    home = place.home
    home.upload(DATA)
    assert home.client.get(f"/v1/blobs/{SHA256}").content == DATA
    place.damage(SHA256, how)
    reply = read(home, SHA256)
    assert reply.status_code == 404 and reply.json()["code"] == "damaged"
    assert SHA256 in reply.json()["detail"] and "again" in reply.json()["remedy"]
    assert home.client.post("/v1/blobs/missing", json={"sha256": [SHA256]}).json() == {"missing": [SHA256]}
    assert home.upload(DATA) == SHA256
    assert home.client.get(f"/v1/blobs/{SHA256}").content == DATA == place.stored(SHA256)
    assert home.client.post("/v1/blobs/missing", json={"sha256": [SHA256]}).json() == {"missing": []}


@pytest.mark.parametrize("how", HOW)
def test_who_asks_whether_a_damaged_blob_is_here_is_told_no(place, how):
    """Though nobody has read it since, and whoever had it first has long gone."""
    home = place.home
    home.upload(DATA)
    assert home.client.post("/v1/blobs/missing", json={"sha256": [SHA256]}).json() == {"missing": []}
    place.damage(SHA256, how)
    assert home.client.post("/v1/blobs/missing", json={"sha256": [SHA256]}).json() == {"missing": [SHA256]}
    home.upload(DATA)
    place.damage(SHA256, how)
    assert home.client.head(f"/v1/blobs/{SHA256}").status_code == 404
    home.upload(DATA)
    assert home.client.head(f"/v1/blobs/{SHA256}").status_code == 200


def test_an_upload_replaces_damage_that_nobody_has_found(place):
    place.home.upload(DATA)
    place.damage(SHA256, flipped)
    place.home.upload(DATA)
    assert place.stored(SHA256) == DATA


def test_a_part_of_a_cut_blob_is_refused(place):
    place.home.upload(DATA)
    place.damage(SHA256, cut)
    for part in ("bytes=0-9", f"bytes={len(DATA) - 10}-"):
        reply = place.home.client.get(f"/v1/blobs/{SHA256}", headers={"Range": part})
        assert reply.status_code == 404 and reply.json()["code"] == "damaged"


@pytest.mark.parametrize("how", HOW)
def test_a_damaged_checkpoint_is_dropped(place, how):
    home = place.home
    home.submit()
    worker = home.worker()
    while (claim := worker.must_claim())["payload"]["kind"] != "fit":
        worker.finish(claim)
    assert worker.checkpoint(claim, DATA).status_code == 204
    place.damage(SHA256, how)
    assert read(home, SHA256).status_code == 404
    assert worker.beat(claim)["stop"] is False, "the attempt that runs goes on"
    assert worker.fail(claim).status_code == 204
    assert worker.must_claim("fit")["checkpoint"] is None


@pytest.mark.parametrize("how", HOW)
def test_a_damaged_file_of_the_bundle_fails_the_job_until_it_is_uploaded_again(place, how):
    home = place.home
    request = home.request(bundle={"entry": "a/scene.glb", "files": {"a/scene.glb": home.upload(DATA)}})
    job = home.client.post("/v1/jobs", json=request).json()
    worker = home.worker()
    claim = worker.must_claim("prepare")
    place.damage(SHA256, how)
    assert read(home, SHA256).status_code == 404
    failed = home.job(job["id"])
    assert failed["state"] == "failed" and "a/scene.glb" in failed["error"]["detail"]
    assert worker.beat(claim)["stop"] is True
    refused = home.client.post(f"/v1/jobs/{job['id']}/retry")
    assert refused.status_code == 404 and "a/scene.glb" in refused.json()["detail"]
    home.upload(DATA)
    assert home.client.post(f"/v1/jobs/{job['id']}/retry").status_code == 200
    while (claim := worker.claim()) is not None:
        worker.finish(claim)
    assert home.job(job["id"])["state"] == "completed"


@pytest.mark.parametrize("how", HOW)
def test_the_task_whose_result_is_damaged_is_done_again_and_rendered_tiles_stay(place, how):
    home = place.home
    job, worker, other = home.submit(), home.worker(), home.worker("other")
    prepare = worker.must_claim("prepare")
    worker.finish(prepare)
    worker.finish(worker.must_claim("render"))
    render = worker.must_claim("render")
    place.damage(render["payload"]["scene"], how)
    assert read(home, render["payload"]["scene"]).status_code == 404
    assert worker.beat(render)["stop"] is True and worker.fail(render).status_code == 409
    states = {task["label"]: task["state"] for task in home.tasks(job["id"]) if task["kind"] in ("prepare", "render")}
    assert states == {"scene": "queued", "tile 0,0": "completed", "tile 0,8": "waiting"}
    again = other.must_claim("prepare", "render")
    assert again["task_id"] == prepare["task_id"] and again["attempt"] == 2
    other.finish(again)
    kinds = []
    while (claim := other.claim()) is not None:
        kinds.append(claim["payload"]["kind"])
        other.finish(claim)
    assert kinds.count("render") == 1 and home.job(job["id"])["state"] == "completed"
    assert "tasks.lost" in home.kinds_of_events(job["id"])


def test_a_scene_that_is_prepared_again_as_another_fails_the_job(home):
    job, worker = home.submit(), home.worker()
    worker.finish(worker.must_claim("prepare"))
    render = worker.must_claim("render")
    place = Place(home, home.config.blob_base)
    place.damage(render["payload"]["scene"], flipped)
    assert read(home, render["payload"]["scene"]).status_code == 404
    claim = worker.must_claim("prepare")
    from_elsewhere = {"kind": "prepare", "seconds": 1.0, "scene": home.upload(b"x"), "texel_map": home.upload(b"y")}
    tiles = [{"row": 0, "column": 0, "size": 8, "texels": 5}]
    rest = {
        "scene_hash": "1" * 64,
        "tiles": tiles,
        "has_environment": False,
        "has_light": True,
        "triangles": 1,
        "resolution": 32,
    }
    reply = worker.commit(claim, from_elsewhere | rest)
    assert reply.status_code == 422 and "scene_hash and texel_map changed" in reply.json()["detail"]
    assert home.job(job["id"])["state"] == "active"


def test_damaged_weights_are_trained_again_and_what_they_led_to_is_done_again(place):
    home = place.home
    job, worker = home.submit(), home.worker()
    while (claim := worker.must_claim())["payload"]["kind"] != "package":
        worker.finish(claim)
    (weights,) = [fit["weights"] for fit in claim["payload"]["fits"]]
    place.damage(weights, flipped)
    assert read(home, weights).status_code == 404
    assert worker.beat(claim)["stop"] is True
    kinds = []
    while (claim := worker.claim()) is not None:
        kinds.append(claim["payload"]["kind"])
        worker.finish(claim)
    assert kinds[0] == "fit" and kinds[-1] == "package" and set(kinds) <= {"fit", "refine", "package"}
    assert home.job(job["id"])["state"] == "completed"


def test_what_a_finished_job_has_lost_is_made_again_when_its_package_is(place):
    home = place.home
    job, worker = home.submit(), home.worker()
    while (claim := worker.claim()) is not None:
        if claim["payload"]["kind"] == "package":
            scene = claim["payload"]["prepare"]["scene"]
        worker.finish(claim)
    (artifact, *_) = home.client.get(f"/v1/jobs/{job['id']}/artifacts").json()
    place.damage(artifact["sha256"], flipped)
    place.damage(scene, flipped)
    assert read(home, artifact["sha256"]).status_code == 404
    url = f"/v1/jobs/{job['id']}/artifacts/{artifact['name']}"
    assert home.client.get(url).json()["code"] == "damaged" and home.job(job["id"])["state"] == "completed"
    assert read(home, scene).status_code == 404
    assert home.client.post(f"/v1/jobs/{job['id']}/requeue", json={"kind": "package"}).status_code == 200
    kinds = []
    while (claim := worker.claim()) is not None:
        kinds.append(claim["payload"]["kind"])
        worker.finish(claim)
    assert kinds == ["prepare", "package"]
    assert home.job(job["id"])["state"] == "completed" and len(home.client.get(url).content) == 1000
