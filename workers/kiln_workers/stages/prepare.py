"""Read the scene, give it a light map, lay out the store: everything the farm needs before the first ray."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.job import check_bundle
from kiln_schemas.settings import BakeSettings, Function, PackagedScene, RenderSettings, Solver
from kiln_schemas.tasks import MOST_NOTES, MOST_PLACEMENTS, MOST_TILES, PreparePayload, PrepareResult
from kiln_workers.package.original import check_original
from kiln_workers.render.between import between_bands
from kiln_workers.runner.context import Context
from kiln_workers.scene.archive import pack_scene, scene_hash
from kiln_workers.scene.atlas import make_lightmap
from kiln_workers.scene.bands import bands
from kiln_workers.scene.lamps import lamp_notes
from kiln_workers.scene.limits import LAYOUT_S, deadline
from kiln_workers.scene.load import check_light, load_scene
from kiln_workers.scene.model import Scene
from kiln_workers.scene.sheets import part_sheets
from kiln_workers.scene.texel_map import (
    COARSE,
    SPECK,
    TexelMap,
    open_texel_map,
    speck_share,
    write_texel_map,
)
from kiln_workers.scene.texels import TexelMaker
from kiln_workers.stages.bundle import lay_out
from kiln_workers.stages.radiance_cache import LARGEST_CACHE, make_cache, pack_cache
from kiln_workers.stages.tiles import plan_tiles
from kiln_workers.store.layout import BETWEEN_STEPS, TEXEL_MAP_ARRAYS
from kiln_workers.store.light_field import LightFieldStore

STEPS: Final = (
    "fetching the scene",
    "reading the scene",
    "laying out the light map",
    "placing the texels",
    "placing the points between",
    "lighting the surfaces",
    "saving",
)


def run(payload: PreparePayload, context: Context) -> PrepareResult:
    """Scene bundle in; parsed scene, texel map, empty store and tiles out."""
    began = time.perf_counter()
    settings, bundle = payload.settings, check_bundle(payload.bundle)

    def step(index: int) -> None:
        context.progress(index, len(STEPS), "steps", STEPS[index])

    step(0)
    folder = lay_out(bundle, context)
    step(1)
    scene = part_sheets(check_light(load_scene(folder, bundle.entry, bundle.environment)))
    scene = replace(scene, notes=(*scene.notes, *lamp_notes(scene)))
    original = settings.package.scene is PackagedScene.ORIGINAL
    if original:
        check_original(folder, bundle.entry)
    step(2)
    with deadline(LAYOUT_S, bundle.entry, "give a light map", "Simplify it, or give it a light-map UV (TEXCOORD_1)."):
        lightmap = make_lightmap(scene, settings.lightmap, may_cut=not original)
        scene = lightmap.scene
        step(3)
        path = _texel_map_file(scene, lightmap.resolution, context)
    texel_map = open_texel_map(path)
    tiles = plan_tiles(texel_map, settings.lightmap.tile)
    if not tiles:
        raise InputError(
            "no texel of the light map is covered",
            where=bundle.entry,
            remedy="Check the size of its light-map charts.",
        )
    if len(tiles) > MOST_TILES:
        raise TooLarge(
            f"{len(tiles)} render tiles are more than {MOST_TILES}",
            where="lightmap.tile",
            remedy="Raise lightmap.tile or lower lightmap.resolution.",
        )
    step(4)
    between = _put_between(scene, texel_map, context) if traces_between(settings) else ()
    fine_side = settings.lightmap.irradiance_side(lightmap.resolution)
    finer = fine_side > lightmap.resolution
    fine_path = _texel_map_file(scene, fine_side, context) if finer else path
    step(5)
    digest = scene_hash(scene, settings.render)
    cache = _put_cache(scene, digest, {lightmap.resolution: path, fine_side: fine_path}, settings.render, context)
    step(6)
    _create_store(payload.store_url, scene, texel_map, digest, settings)
    context.log(f"{scene.triangles} triangles, {texel_map.covered} texels in {len(tiles)} tiles")
    return PrepareResult(
        scene=context.put_blob(pack_scene(scene)),
        texel_map=context.put_blob(path),
        between=between,
        fine=context.put_blob(fine_path) if finer else None,
        cache=cache,
        scene_hash=digest,
        resolution=lightmap.resolution,
        placements=lightmap.placements[:MOST_PLACEMENTS],
        tiles=tiles,
        has_environment=scene.environment is not None,
        has_light=scene.has_light,
        triangles=scene.triangles,
        notes=few_notes((*_coarse_note(texel_map), *scene.notes)),
        seconds=time.perf_counter() - began,
    )


def _texel_map_file(scene: Scene, resolution: int, context: Context) -> Path:
    """A file with the scene's texel map."""
    path, maker = context.scratch / f"texels-{resolution}", TexelMaker(scene, resolution)
    write_texel_map(path, maker.shape, (maker.pushed(rows) for rows in bands(maker.shape)))
    return path


def _put_between(scene: Scene, texel_map: TexelMap, context: Context) -> tuple[str, ...]:
    """The texel maps of the points between, as blobs."""
    shape = (texel_map.state.shape[0], texel_map.state.shape[1])
    digests = []
    for number, way in enumerate(BETWEEN_STEPS):
        path = context.scratch / f"between-{number}"
        write_texel_map(path, shape, between_bands(scene, texel_map, way))
        digests.append(context.put_blob(path))
        path.unlink()
    return tuple(digests)


def _put_cache(
    scene: Scene, digest: str, files: Mapping[int, Path], settings: RenderSettings, context: Context
) -> str | None:
    """The radiance cache as a blob, at the finest of the texel maps that is not too large; None where paths do without.

    `files`: where the texel maps lie, by the texels along each side.
    """
    if not (settings.radiance_cache and settings.max_depth and scene.has_light):
        return None
    side = max((side for side in files if side <= LARGEST_CACHE), default=LARGEST_CACHE)
    texel_map = open_texel_map(files.get(side) or _texel_map_file(scene, side, context))

    def report(done: float) -> None:
        context.progress(5 + done, len(STEPS), "steps", STEPS[5])

    cache = make_cache(scene, digest, texel_map, settings, context.memory_bytes, report)
    return context.put_blob(pack_cache(cache))


def traces_between(settings: BakeSettings) -> bool:
    """Whether the fit learns from light fields between texels."""
    return settings.fit.solver is Solver.COHERENT and settings.render.between_samples > 0


def few_notes(notes: Sequence[str]) -> tuple[str, ...]:
    """The first notes; a scene of a hundred thousand meshes has as many to tell."""
    if len(notes) <= MOST_NOTES:
        return tuple(notes)
    kept = MOST_NOTES - 1
    return (*notes[:kept], f"{len(notes) - kept} more notes are left out.")


def _coarse_note(texel_map: TexelMap) -> list[str]:
    share = speck_share(texel_map.chart)
    if share <= COARSE:
        return []
    return [
        f"Light map: too coarse for this scene. {100 * share:.0f} % of its texels lie in charts of {SPECK} texels or"
        " fewer, where light cannot change. Raise lightmap.resolution or lightmap.most."
    ]


def _create_store(url: str, scene: Scene, texel_map: TexelMap, digest: str, settings: BakeSettings) -> None:
    side = texel_map.state.shape[0]
    store = LightFieldStore.create(
        url,
        shape=(texel_map.state.shape[0], texel_map.state.shape[1]),
        image_size=settings.render.image_size,
        tile=settings.lightmap.tile,
        functions=[Function.LIGHT_FIELD] + ([Function.VISIBILITY] if scene.environment else []),
        between=traces_between(settings),
        irradiance_scale=settings.lightmap.irradiance_side(side) // side,
        attributes={"scene_hash": digest, "settings": settings.model_dump(mode="json")},
    )
    store.write_texel_map({name: getattr(texel_map, name) for name in TEXEL_MAP_ARRAYS})
