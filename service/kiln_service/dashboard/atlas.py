"""What a job's page draws: which texels there are, their irradiance, single light fields."""

import base64
from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, Path, Query
from fastapi.responses import JSONResponse, Response

from kiln_schemas.conventions import LIGHT_FIELD_KTX2
from kiln_schemas.errors import InputError, KilnError, NotFound
from kiln_schemas.operators import Scope
from kiln_service import views
from kiln_service.api.common import Parts, PartsHere, caller
from kiln_service.dashboard.light_fields import LightFields, TexelMapReader
from kiln_service.dashboard.lobes import read_lobes
from kiln_service.dashboard.pages import see
from kiln_service.db import JobRow

router = APIRouter(include_in_schema=False, dependencies=[Depends(caller(Scope.READ))], prefix="/jobs/{job_id}")

MOST_TILES: Final = 256
"""Tiles of one request."""
MOST_STATES: Final = 2048
"""Texels along each side of the largest light map whose texels are told one by one."""

Coordinate = Annotated[int, Path(ge=0, lt=8192)]
Stride = Annotated[int, Query(ge=1, le=64)]


@router.get("/texels")
async def texels(job_id: str, parts: PartsHere, stride: Stride = 1) -> Response:
    """What every `stride`-th texel is, a byte each: 0 gutter, 1 valid, 2 inside geometry; 404 before it is known."""
    job = await _job(parts, job_id)
    if (job.lightmap_side or 0) > MOST_STATES:
        raise NotFound("the light map is too large to tell its texels", where="lightmap.resolution")
    return _bytes(await (await _texel_map(parts, job)).states(stride))


@router.get("/irradiance")
async def irradiance(
    job_id: str,
    parts: PartsHere,
    tile: Annotated[list[str], Query(max_length=MOST_TILES, description="row,column of the first texel")],
    stride: Stride = 1,
) -> Response:
    """float32 RGB of tiles in the order given, each whole, every `stride`-th texel of it."""
    job = await _job(parts, job_id)
    side = job.settings.lightmap.tile
    if side % stride:
        raise InputError(f"{stride} does not divide the tile's {side} texels", where="stride")
    places = [_tile(word) for word in tile]
    fields = LightFields(job.store_url, job.settings)
    await fields.open()
    return _bytes(await fields.irradiance(places, stride, await _rendered(parts, job_id, places)))


@router.get("/texels/{row}/{column}")
async def texel(job_id: str, row: Coordinate, column: Coordinate, parts: PartsHere) -> Response:
    """One texel: its normal, its light field as rendered (float16 in base64), and its lobes; why what is missing is."""
    job = await _job(parts, job_id)
    side = job.lightmap_side
    if side is None:
        raise NotFound("the size of the light map is not chosen yet", where="prepare")
    if max(row, column) >= side:
        raise InputError(f"the light map has no texel {row}, {column}", where="texel")
    told: dict[str, Any] = {"row": row, "column": column, "image_size": job.settings.render.image_size, "missing": {}}
    texel_map, side = await _texel_map(parts, job), job.settings.lightmap.tile
    told["normal"] = await texel_map.normal(row, column)
    rendered = await _rendered(parts, job_id, [(row // side * side, column // side * side)])
    try:
        fields = LightFields(job.store_url, job.settings)
        await fields.open()
        covered = bool(rendered) and await texel_map.has_surface(row, column)
        told["image"] = base64.b64encode(await fields.image(row, column, covered)).decode()
    except KilnError as error:
        told["missing"]["image"] = error.problem().sentence()
    try:
        found = await views.artifact(parts.database, job_id, LIGHT_FIELD_KTX2)
    except NotFound:
        told["missing"]["lobes"] = "The lobes can be shown once the package is there."
        return JSONResponse(told)
    try:
        told["lobes"] = await read_lobes(parts.blobs, found.sha256, row, column)
    except KilnError as error:
        told["missing"]["lobes"] = error.problem().sentence()
    return JSONResponse(told)


@router.get("/tiles/{row}/{column}")
async def tile_task(job_id: str, row: Coordinate, column: Coordinate, parts: PartsHere) -> Response:
    """The page of the task that renders a tile."""
    async with parts.database.transaction() as tx:
        found = await tx.maybe("tile_task", job_id=job_id, row=row, column=column)
    if found is None:
        raise NotFound(f"no tile begins at texel {row}, {column}", where="tile")
    return see(f"/tasks/{found['id']}")


async def _job(parts: Parts, job_id: str) -> JobRow:
    async with parts.database.transaction() as tx:
        row = await tx.maybe("find_job", id=job_id)
    if row is None:
        raise NotFound(f"no job '{job_id}'", where="job")
    return JobRow.of(row)


async def _rendered(parts: Parts, job_id: str, places: list[tuple[int, int]]) -> set[tuple[int, int]]:
    """Those of the tiles (row, column of the first texel) that are rendered: the store must have them."""
    rows, columns = [row for row, _ in places], [column for _, column in places]
    async with parts.database.transaction() as tx:
        found = await tx.all("rendered_tiles", job_id=job_id, rows=rows, columns=columns)
    return {(row["row"], row["column"]) for row in found}


async def _texel_map(parts: Parts, job: JobRow) -> TexelMapReader:
    if job.prepared is None or job.lightmap_side is None:
        raise NotFound("the texel map is not made yet", where="prepare")
    reader = TexelMapReader(parts.blobs, job.prepared["texel_map"], job.lightmap_side)
    await reader.open()
    return reader


def _tile(word: str) -> tuple[int, int]:
    row, comma, column = word.partition(",")
    if not comma or not (row + column).isascii() or not (row + column).isdigit() or max(len(row), len(column)) > 5:
        raise InputError(f"'{word}' is not ROW,COLUMN", where="tile")
    return int(row), int(column)


def _bytes(data: bytes) -> Response:
    return Response(data, media_type="application/octet-stream", headers={"Cache-Control": "no-store"})
