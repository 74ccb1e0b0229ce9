"""The same where light fields and blobs are in a bucket of a real S3 server."""

import base64

import numpy as np
import pytest
import seaweed


@pytest.fixture
def home(start, tmp_path, monkeypatch):
    folder = tmp_path / "seaweedfs"
    folder.mkdir()
    with seaweed.running(folder) as server:
        for name, value in server.environment().items():
            monkeypatch.setenv(name, value)
        bucket = f"s3://{server.bucket}"
        with start(store_url=f"{bucket}/store", blob_url=f"{bucket}/blobs") as coordinator:
            yield coordinator


def test_tiles_texels_and_lobes_come_out_of_a_bucket(home, job, rendered, tmp_path):
    folder = tmp_path / "package"
    folder.mkdir()
    lobes = next(file for file in rendered.artifacts(folder) if file["name"] == "lightfield.ktx2")
    home.sql("INSERT INTO artifacts VALUES (%s, 'lightfield.ktx2', %s, 1, 'image/ktx2')", job, lobes["sha256"])
    reply = home.client.get(f"/jobs/{job}/irradiance", params={"tile": ["0,8", "0,16"]}).raise_for_status()
    told = np.frombuffer(reply.content, np.float32).reshape(2, 8, 8, 3)
    np.testing.assert_array_equal(told[0], rendered.irradiance(0, 8))
    assert told[0].any() and not told[1].any()
    states = home.client.get(f"/jobs/{job}/texels").raise_for_status().content
    np.testing.assert_array_equal(np.frombuffer(states, np.uint8), rendered.state.reshape(-1))
    texel = home.client.get(f"/jobs/{job}/texels/5/10").raise_for_status().json()
    image = np.frombuffer(base64.b64decode(texel["image"]), np.float16).reshape(32, 32, 3)
    np.testing.assert_array_equal(image, rendered.images[5, 10])
    np.testing.assert_array_equal(np.float32(texel["lobes"]), rendered.lobes[5, 10])
    absent = home.client.get(f"/jobs/{job}/texels/20/20").raise_for_status().json()
    assert not any(base64.b64decode(absent["image"]))
