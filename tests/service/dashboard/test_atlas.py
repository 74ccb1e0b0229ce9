"""What the job's page reads of the store and the package, held against what was written there."""

import base64
import json
import shutil
import struct
from pathlib import Path
from urllib.parse import urlparse

import numpy as np
import pytest
import zstandard

from kiln_schemas.states import TaskState
from kiln_workers.package import ktx2
from kiln_workers.package.half import lobes_to_layers


def test_tiles_are_told_with_their_states(home, job, rendered):
    told = home.client.get(f"/v1/jobs/{job}/tiles")
    states = [list(TaskState)[code - 1].value if code else None for code in told.content]
    assert told.headers["x-side"] == "4"
    assert states == ["completed", "completed", "queued", "queued", *12 * [None]]
    page = home.client.get(f"/jobs/{job}").text
    assert 'data-tile="8" data-states="' + " ".join(TaskState) in page


def test_texels_and_irradiance_are_thinned_by_a_stride(home, job, rendered):
    for stride in (1, 2, 4, 8):
        check_stride(home, job, rendered, stride)


def check_stride(home, job, rendered, stride):
    states = home.client.get(f"/jobs/{job}/texels", params={"stride": stride}).raise_for_status().content
    np.testing.assert_array_equal(np.frombuffer(states, np.uint8), rendered.state[::stride, ::stride].reshape(-1))
    query = {"stride": stride, "tile": ["0,8", "0,16"]}
    reply = home.client.get(f"/jobs/{job}/irradiance", params=query).raise_for_status()
    told = np.frombuffer(reply.content, np.float32).reshape(2, 8 // stride, 8 // stride, 3)
    stored = rendered.irradiance(0, 8)[::stride, ::stride]
    np.testing.assert_array_equal(told[0], stored)
    assert stored.any() and not told[1].any()  # the second is not rendered


def test_a_texel_is_told_as_it_lies_in_the_store(home, job, rendered):
    for row, column in ((0, 0), (5, 10), (7, 14)):
        told = home.client.get(f"/jobs/{job}/texels/{row}/{column}").raise_for_status().json()
        image = np.frombuffer(base64.b64decode(told["image"]), np.float16).reshape(32, 32, 3)
        np.testing.assert_array_equal(image, rendered.images[row, column])
        assert told["normal"] == pytest.approx([0.0, 0.6, 0.8]) and "package" in told["missing"]["lobes"]
    gutter = home.client.get(f"/jobs/{job}/texels/0/7").json()  # within a shard
    unknown = home.client.get(f"/jobs/{job}/texels/20/20").json()  # no shard
    assert not any(base64.b64decode(gutter["image"])) and not any(base64.b64decode(unknown["image"]))


def test_lobes_are_read_from_the_package(home, job, rendered, tmp_path):
    layers, _ = lobes_to_layers(rendered.lobes)
    home.sql("INSERT INTO artifacts VALUES (%s, 'lightfield.ktx2', %s, 1, 'image/ktx2')", job, home.upload(b"nothing"))
    for supercompress in (False, True):
        data = ktx2.encode(ktx2.texture_array(layers, {}), supercompress=supercompress)
        home.sql("UPDATE artifacts SET sha256 = %s", home.upload(data))
        for row, column in ((0, 0), (17, 3), (31, 31)):
            told = home.client.get(f"/jobs/{job}/texels/{row}/{column}").raise_for_status().json()
            np.testing.assert_array_equal(np.float32(told["lobes"]), rendered.lobes[row, column])


def test_lobes_that_cannot_be_read_are_a_sentence(home, job, rendered):
    home.sql("INSERT INTO artifacts VALUES (%s, 'lightfield.ktx2', %s, 1, 'image/ktx2')", job, home.upload(b"nothing"))
    texture = ktx2.texture_array(lobes_to_layers(rendered.lobes)[0], {})
    plain, packed = ktx2.encode(texture), ktx2.encode(texture, supercompress=True)
    offset, length, size = struct.unpack_from("<3Q", packed, 80)

    def repacked(stream: bytes, width: int = 32) -> bytes:
        """The compressed file with other bytes as its level."""
        head = bytearray(packed[:offset])
        struct.pack_into("<I", head, 20, width)
        struct.pack_into("<2Q", head, 88, len(stream), size * width // 32)
        return bytes(head) + stream

    too_far = zstandard.ZstdCompressionParameters.from_level(3, window_log=27)
    compressor = zstandard.ZstdCompressor(compression_params=too_far).compressobj()  # of a size that it does not know
    for data, sentence in (
        (b"not a texture", "is no KTX2 file"),
        (plain[:104] + bytes(1000), "ends before its lobes"),
        (packed[:-1], "ends before its lobes"),
        (repacked(packed[offset : offset + length // 2]), "ends before its lobes"),
        (repacked(b"no frame of Zstandard"), "cannot be inflated"),
        (repacked(compressor.compress(bytes(size)) + compressor.flush()), "cannot be inflated"),
        (repacked(zstandard.compress(b""), width=2**20), "4.0 GiB are too much"),
    ):
        home.sql("UPDATE artifacts SET sha256 = %s", home.upload(data))
        told = home.client.get(f"/jobs/{job}/texels/1/1").raise_for_status().json()
        assert "lobes" not in told and sentence in told["missing"]["lobes"], told["missing"]
        assert base64.b64decode(told["image"])


def test_a_store_that_is_gone_is_a_sentence(home, job, rendered):
    shutil.rmtree(rendered.store.url.removeprefix("file://"))
    reply = home.client.get(f"/jobs/{job}/irradiance", params={"tile": "0,0"})
    assert reply.status_code == 404 and "cannot read the light fields" in reply.json()["detail"]
    assert "Mount the store" in reply.json()["remedy"]
    told = home.client.get(f"/jobs/{job}/texels/1/1").raise_for_status().json()
    assert "image" not in told and "cannot read the light fields" in told["missing"]["image"]


def test_a_damaged_shard_is_a_sentence(home, job, rendered):
    folder = rendered.store.url.removeprefix("file://")
    with Path(folder, "light_field/c/0/0/0/0/0").open("r+b") as shard:
        shard.seek(-(16 * 64 + 4), 2)
        shard.write((0).to_bytes(8, "little") + (2**40).to_bytes(8, "little"))
    told = home.client.get(f"/jobs/{job}/texels/0/0").raise_for_status().json()
    assert "its checksum is wrong" in told["missing"]["image"]


def test_a_texel_map_of_something_else_is_a_sentence(home, job, rendered):
    header = json.dumps({"arrays": {"state": {"shape": [10**9, 10**9], "offset": 0}}}).encode()
    for data in (b"", b"KILNARR1", b"KILNARR1" + len(header).to_bytes(8, "little") + header):
        result = json.dumps(home.upload(data))
        home.sql("UPDATE jobs SET prepared = jsonb_set(prepared, '{texel_map}', %s)", result)
        reply = home.client.get(f"/jobs/{job}/texels")
        assert reply.status_code == 422 and "does not fit the job" in reply.json()["detail"]


def test_what_makes_no_sense_is_refused(home, job):
    for path, status in {
        "irradiance": 422,
        "irradiance?tile=1": 422,
        "irradiance?tile=-1,0": 422,
        "irradiance?tile=0,%2E%2E": 422,
        "irradiance?tile=0,0&stride=3": 422,
        "irradiance?" + "&".join(["tile=0,0"] * 300): 422,
        "texels?stride=0": 422,
        "texels/32/0": 404,
        "texels/99999/0": 422,
        "tiles/0/1": 404,
        "do/explode": 405,
    }.items():
        reply = home.client.get(f"/jobs/{job}/{path}")
        assert reply.status_code == status, (path, reply.text)
        assert reply.headers["content-type"] == "application/problem+json"


def test_an_unknown_job_has_no_pages(shared):
    for path in ("", "/texels", "/irradiance?tile=0,0", "/texels/0/0", "/tiles/0/0"):
        reply = shared.client.get(f"/jobs/nobody{path}", headers={"Accept": "text/html"})
        assert reply.status_code == 404 and "<h1>Not found</h1>" in reply.text


def test_damage_of_the_store_is_told_and_never_drawn_as_black(home, job, rendered):
    """A wrong byte, a cut object and a lost one of a rendered tile: of its irradiance, and of a texel's light field."""
    root = Path(urlparse(rendered.store.url).path)
    places = {"irradiance/c/0/1/0": f"/jobs/{job}/irradiance?tile=0,8", "light_field/c/0/1/0/0/0": None}
    for name, url in places.items():
        file = root / name
        data = file.read_bytes()
        for damaged in (data[:-9] + bytes([data[-9] ^ 1]) + data[-8:], data[: len(data) // 2], None):
            file.unlink() if damaged is None else file.write_bytes(damaged)
            if url is not None:
                reply = home.client.get(url)
                assert reply.status_code == 404 and name in reply.text
            else:
                told = home.client.get(f"/jobs/{job}/texels/0/8").raise_for_status().json()
                assert "image" not in told and name in told["missing"]["image"]
            file.write_bytes(data)
    assert home.client.get(places["irradiance/c/0/1/0"]).status_code == 200
    assert "image" in home.client.get(f"/jobs/{job}/texels/0/8").json()
