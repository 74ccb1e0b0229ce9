"""A small kept bake: a room with a lamp, prepared and rendered by the real stages, packaged with lobes of its own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from e2e_farm import TINY, room
from in_process import MemoryContext

from kiln_schemas import conventions
from kiln_schemas.manifest import Manifest, ManifestMetrics
from kiln_schemas.settings import Function, make_settings
from kiln_schemas.tasks import Bundle, FitMetrics, PreparePayload, RenderPayload
from kiln_workers.fit.metrics import exposure_of
from kiln_workers.fit.source import StoreSource
from kiln_workers.package import exr, ktx2
from kiln_workers.package.files import artifact
from kiln_workers.package.glb import encode_glb
from kiln_workers.package.half import lobes_to_layers
from kiln_workers.scene.archive import unpack_scene
from kiln_workers.scene.texel_map import unpack_texel_map
from kiln_workers.stages import prepare, render
from kiln_workers.store.light_field import LightFieldStore

JOB = "0" * 32


@pytest.fixture(scope="session")
def kept_bake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package's folder, with its store where `bake --keep` leaves it. Read only."""
    folder = tmp_path_factory.mktemp("compare") / "room"
    (folder / ".lightkiln" / "store").mkdir(parents=True)
    context = MemoryContext(folder / "scratch")
    context.scratch.mkdir()
    settings = make_settings("draft", [*TINY, "render.irradiance_samples=16", "render.samples=16"])
    url = f"file://{folder}/.lightkiln/store/{JOB}.zarr"
    bundle = Bundle(entry="room.glb", files={"room.glb": context.put_blob(encode_glb(room()))}, environment=None)
    prepared = prepare.run(PreparePayload(bundle=bundle, settings=settings, store_url=url), context)
    common: dict[str, Any] = {"settings": settings, "store_url": url}
    for tile in prepared.tiles:
        payload = RenderPayload(
            scene=prepared.scene, texel_map=prepared.texel_map, between=prepared.between, tile=tile, **common
        )
        render.run(payload, context)
    texel_map = unpack_texel_map(context.blob(prepared.texel_map))
    store = LightFieldStore.open(url)
    source = StoreSource(store, Function.LIGHT_FIELD, texel_map.state, texel_map.normal, prepared.tiles)
    layers, _ = lobes_to_layers(np.tile(np.array([0, 1, 0, 1, 0, 0, 0], np.float32), (*texel_map.state.shape, 1, 1)))
    ktx2.write(folder / conventions.LIGHT_FIELD_KTX2, ktx2.texture_array(layers, {}))
    exr.write_rgb(folder / conventions.IRRADIANCE_EXR, store.read_irradiance(prepared.tiles))
    (folder / conventions.SCENE_GLB).write_bytes(encode_glb(unpack_scene(context.blob(prepared.scene))))
    fitted = FitMetrics(log_mse=0.1, log_mse_zero=1.0, log_mse_rel=0.1, texels=144, signal=True)
    manifest = Manifest(
        format_version=conventions.FORMAT_VERSION,
        generator="test",
        job_id=JOB,
        job_name="room",
        settings=settings,
        scene_hash=prepared.scene_hash,
        inputs=dict(bundle.files),
        environment=None,
        seeds={},
        exposure={"light_field": exposure_of(source, Function.LIGHT_FIELD)},
        metrics=ManifestMetrics(light_field=fitted, visibility=None),
        textures={conventions.LIGHT_FIELD_KTX2: {}},
        lightmap={},
        stage_seconds={},
        overflows=0,
        versions={},
        notes=(),
        files=(artifact(folder, conventions.SCENE_GLB),),
    )
    (folder / conventions.MANIFEST_JSON).write_text(manifest.model_dump_json())
    return folder
