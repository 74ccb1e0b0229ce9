"""Planning and estimating, without a database."""

import time

import pytest

from kiln_schemas.errors import InputError, TooLarge
from kiln_schemas.gates import Gates
from kiln_schemas.settings import PRESETS, make_settings
from kiln_schemas.tasks import PrepareResult, TaskKind, Tile
from kiln_service.ids import new_id
from kiln_service.planner import SG_LIGHTFIELD, plan_after_prepare, plan_blocks, plan_job
from kiln_service.views import remaining_seconds


def prepared(tiles, **changes):
    about = {"scene": "0" * 64, "texel_map": "1" * 64, "scene_hash": "2" * 64, "triangles": 1, "seconds": 1.0}
    about |= {"has_environment": True, "has_light": True, "resolution": 32}
    return PrepareResult(tiles=tuple(tiles), **about | changes)


def tile(row, column, texels=3):
    return Tile(row=row, column=column, size=8, texels=texels)


def plan(result, most=100):
    return plan_after_prepare(result, PRESETS["draft"], Gates(), most)


def test_the_plan():
    assert [(task.kind, task.ready) for task in plan_job()] == [(TaskKind.PREPARE, True)]
    planned = plan(prepared([tile(8, 0), tile(0, 8), tile(0, 0)]))
    assert [task.label for task in planned] == [
        "tile 0,0",
        "tile 0,8",
        "tile 8,0",
        "light_field",
        "visibility",
        "block 0,0",
        "package",
    ]
    assert [task.ready for task in planned] == [True, True, True, False, False, False, False]
    assert planned[1].spec == {"tile": {"row": 0, "column": 8, "size": 8, "texels": 3}}


def test_blocks_are_those_that_tiles_touch():
    """Also where tiles do not lie on the grid of the blocks; none where the network's lobes are final."""
    settings = make_settings("draft", ["lightmap.tile=24", "fit.block=16"])
    tiles = [Tile(row=0, column=0, size=24, texels=3), Tile(row=24, column=24, size=24, texels=1)]
    places = [(block.row, block.column, block.size) for block in plan_blocks(prepared(tiles), settings)]
    assert places == [(0, 0, 16), (0, 16, 16), (16, 0, 16), (16, 16, 16)]
    network = make_settings("draft", ["fit.solver=cnn"])
    planned = plan_after_prepare(prepared([tile(0, 0)]), network, Gates(), 100)
    assert [task.kind for task in planned] == [TaskKind.RENDER, TaskKind.FIT, TaskKind.FIT, TaskKind.PACKAGE]


def test_stages_follow_each_other():
    order, kind = [], TaskKind.PREPARE
    while kind is not None:
        order.append(kind)
        kind = SG_LIGHTFIELD.stage_after(kind)
    assert order == [TaskKind.PREPARE, TaskKind.RENDER, TaskKind.FIT, TaskKind.REFINE, TaskKind.PACKAGE]


@pytest.mark.parametrize(
    ("result", "word"),
    [
        (prepared([]), "no texel"),
        (prepared([tile(0, 0)], has_light=False), "no light"),
        (prepared([tile(0, 0), tile(0, 0)]), "overlap"),
        (prepared([tile(0, 32)]), "leave"),
        (prepared([tile(0, 0, texels=0)]), "empty"),
        (prepared([tile(0, 0)], resolution=None), "chose no resolution"),
    ],
)
def test_what_cannot_be_baked(result, word):
    with pytest.raises(InputError, match=word):
        plan(result)


def test_too_many_tiles():
    with pytest.raises(TooLarge, match="more than 1"):
        plan(prepared([tile(0, 0), tile(0, 8)]), most=1)


def test_too_many_blocks():
    """A tile of 64 texels holds 64 blocks of 8, which are tasks too."""
    settings = make_settings("production", ["fit.block=8", "lightmap.tile=64"])
    result = prepared([Tile(row=0, column=64, size=64, texels=9)], resolution=512)
    assert len(plan_after_prepare(result, settings, Gates(), 64)) == 1 + 2 + 64 + 1
    with pytest.raises(TooLarge, match="64 blocks to refine are more than 63") as refused:
        plan_after_prepare(result, settings, Gates(), 63)
    assert refused.value.where == "fit.block" and "fit.block" in refused.value.remedy
    network = make_settings("production", ["fit.block=8", "lightmap.tile=64", "fit.solver=cnn"])
    assert len(plan_after_prepare(result, network, Gates(), 63)) == 1 + 2 + 1, "no blocks, nothing to refuse"


def stage(total, completed=0, seconds=0.0, running=()):
    fractions, elapsed = [list(part) for part in zip(*running, strict=True)] if running else [None, None]
    return {"total": total, "completed": completed, "seconds": seconds, "fractions": fractions, "elapsed": elapsed}


@pytest.mark.parametrize(
    ("rows", "seconds"),
    [
        ([], None),
        ([stage(4)], None),
        ([stage(4, running=[(0.01, 3.0)])], None),
        ([stage(1, running=[(0.25, 10.0)])], 30.0),
        ([stage(4, completed=2, seconds=20.0)], 20.0),
        ([stage(4, completed=2, seconds=20.0, running=[(0.5, 5.0), (0.5, 5.0)])], 5.0),
        ([stage(10, completed=2, seconds=20.0, running=[(0.0, 0.0), (0.0, 0.0)])], 40.0),
        ([stage(1, completed=1, seconds=20.0), stage(2, completed=1, seconds=6.0), stage(1)], 6.0),
        ([stage(1, completed=1, seconds=20.0)], None),
    ],
)
def test_remaining_seconds(rows, seconds):
    assert remaining_seconds(rows) == seconds


def test_ids_sort_by_time_and_are_version_7():
    first = new_id()
    time.sleep(0.002)
    second = new_id()
    assert first < second and len(first) == 32 and first[12] == "7" and first[16] in "89ab"
    assert len({new_id() for _ in range(1000)}) == 1000
