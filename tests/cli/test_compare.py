"""`lightkiln compare JOB`: where a job's store, package and environment come from."""

import hashlib
from pathlib import Path

import pytest

from kiln_schemas.errors import InputError, NotFound
from kiln_schemas.manifest import Manifest, ManifestMetrics
from kiln_schemas.settings import PRESETS
from kiln_service.cli import compare
from kiln_service.cli.options import connect


def test_a_job_s_store_lies_in_the_coordinator_s_data(tmp_path: Path) -> None:
    job = "a" * 32
    with pytest.raises(NotFound, match=f"Name it with --store: .* /{job}.zarr"):
        compare._store(job, tmp_path)
    with pytest.raises(NotFound, match="not known"):
        compare._store(job, None)
    (tmp_path / "store" / f"{job}.zarr").mkdir(parents=True)
    assert compare._store(job, tmp_path) == f"file://{tmp_path}/store/{job}.zarr"


def test_blobs_arrive_whole(coordinator, tmp_path: Path) -> None:
    content = b"an environment" * 1000
    digest = hashlib.sha256(content).hexdigest()
    (tmp_path / "sky.hdr").write_bytes(content)
    with connect(coordinator.url, None, coordinator.data) as api:
        api.put_blob(digest, tmp_path / "sky.hdr", lambda _: None)
        api.get_blob(digest, tmp_path / "back.hdr")
        assert (tmp_path / "back.hdr").read_bytes() == content
        with pytest.raises(NotFound):
            api.get_blob("0" * 64, tmp_path / "none.hdr")


def test_another_job_s_package_is_not_taken(tmp_path: Path) -> None:
    assert not compare._is_package_of(tmp_path, "a" * 32)
    (tmp_path / "manifest.json").write_text(_manifest("b" * 32))
    with pytest.raises(InputError, match="another job"):
        compare._is_package_of(tmp_path, "a" * 32)
    assert compare._is_package_of(tmp_path, "b" * 32)


def _manifest(job: str) -> str:
    return Manifest(
        format_version=1,
        generator="test",
        job_id=job,
        job_name="room",
        settings=PRESETS["draft"],
        scene_hash="a" * 64,
        inputs={},
        environment=None,
        seeds={},
        exposure={},
        metrics=ManifestMetrics(light_field=None, visibility=None),
        textures={},
        lightmap={},
        stage_seconds={},
        overflows=0,
        versions={},
        notes=(),
        files=(),
    ).model_dump_json()
