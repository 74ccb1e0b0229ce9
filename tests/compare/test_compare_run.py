"""Interruptions, failed fits, curves and estimates of a comparison."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from kiln_schemas.errors import FitFailed, InputError, NotFound
from kiln_workers.compare import charts
from kiln_workers.compare.convergence import epochs_to_tolerance
from kiln_workers.compare.pictures import PictureSettings
from kiln_workers.compare.progress import Estimate
from kiln_workers.compare.result import CurvePoint
from kiln_workers.compare.run import Plan, run
from kiln_workers.compare.subject import open_subject
from kiln_workers.compare.texels import choose_texels
from kiln_workers.compare.warm import warm_start
from kiln_workers.fit.field import TexelField
from kiln_workers.fit.metrics import texel_errors
from kiln_workers.fit.network import Shape, initial_parameters
from kiln_workers.fit.predict import Weights, predict
from kiln_workers.fit.solution import Lobes, OnEpoch, Solution, Solver, nobody
from kiln_workers.fit.solvers import SOLVERS
from kiln_workers.fit.solvers.descent import AdamOptions
from kiln_workers.fit.solvers.evaluate import errors_at_texels
from kiln_workers.package.half import as_stored


def steady(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody) -> Solution:
    """Converges towards darkness."""
    made = Lobes(torch.ones(len(field), lobes, 7))
    for epoch in range(1, 31):
        made = Lobes(torch.cat([made.parameters[..., :4], torch.full((len(field), lobes, 3), 2.0**-epoch)], dim=-1))
        on_epoch(epoch, made)
    return Solution(made, 30, 1.5)


def turned(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody) -> Solution:
    """Every texel has directions of its own."""
    angle = torch.arange(len(field) * lobes).reshape(len(field), lobes) * 0.1
    axes = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    return Solution(Lobes(torch.cat([axes, torch.ones(len(field), lobes, 4)], dim=-1)), 1, 0.1)


def stopped(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody) -> Solution:
    raise KeyboardInterrupt


def failed(field: TexelField, lobes: int, on_epoch: OnEpoch = nobody) -> Solution:
    raise FitFailed("the fit did not beat P = 0")


def plan(out: Path, solvers: dict[str, Solver], resolutions: tuple[int, ...] = ()) -> Plan:
    return Plan(
        out=out,
        solvers=solvers,
        network=steady,
        lobes=(3,),
        resolutions=resolutions,
        resolution_image_size=16,
        warm=None,
        cameras={},
        pictures=PictureSettings(16, 16, 2),
        stored=False,
        tiles=2,
        between=10,
        between_factor=1.0,
        memory_bytes=1 << 28,
        quiet=True,
    )


def test_an_interruption_keeps_what_is_finished(kept_bake: Path, tmp_path: Path) -> None:
    subject = open_subject(str(kept_bake), None, None, None)
    solvers: dict[str, Solver] = {"steady": steady, "failed": failed, "late": stopped}
    first = run(subject, plan(tmp_path, solvers))
    assert not first.complete and [row.solver for row in first.rows] == ["steady"]
    assert "not finished" in (tmp_path / "index.html").read_text()
    assert any("did not beat" in note for note in first.notes)
    second = run(subject, plan(tmp_path, {**solvers, "late": steady}))
    assert second.complete and [row.solver for row in second.rows] == ["steady", "late"]
    assert second.rows[0] == first.rows[0]
    assert second.rows[0].seconds == 1.5 and second.rows[0].epochs == 30
    curve = second.rows[0].curve
    assert [point.epoch for point in curve][:4] == [1, 2, 3, 4] and curve[-1].epoch == 30
    assert 5 < len(curve) < 20


def test_a_light_map_of_another_size_converges(kept_bake: Path, tmp_path: Path) -> None:
    subject = open_subject(str(kept_bake), None, None, None)
    result = run(subject, plan(tmp_path, {}, (8, 16)))
    small, same = result.resolutions
    assert (small.resolution, small.image_size, same.resolution) == (8, 16, 16)
    assert 0 < small.texels < 100 and same.texels == 144
    stored = choose_texels(subject, None).field
    darkness = errors_at_texels(Lobes(torch.zeros(144, 1, 7)), stored).log_mse
    assert same.log_mse == pytest.approx(darkness, rel=1e-3)  # its light fields are those of the store
    assert same.log_mse_rel == pytest.approx(1.0, rel=1e-3)
    assert small.curve[-1].epoch == small.epochs == 30 and small.seconds_per_epoch == pytest.approx(0.05)


def test_epochs_to_tolerance() -> None:
    def curve(*errors: float) -> tuple[CurvePoint, ...]:
        return tuple(CurvePoint(epoch=10 * n, log_mse=e, log_mse_between=None) for n, e in enumerate(errors, 1))

    assert epochs_to_tolerance(curve(4.0, 1.04, 2.0, 1.04, 1.02, 1.0)) == 40
    assert epochs_to_tolerance(curve(1.0)) == 10
    assert epochs_to_tolerance(()) is None


def test_estimates_say_what_they_leave_out() -> None:
    estimate = Estimate([("a", 10.0), ("a", 20.0), ("b", 10.0)])
    assert estimate.seconds() == (0.0, 2)
    estimate.finished("a", 10.0, 5.0)
    assert estimate.seconds() == (10.0, 1)
    estimate.finished("b", 10.0, 100.0)
    assert estimate.seconds() == (10.0, 0)
    estimate.finished("a", 20.0, None)
    assert estimate.seconds() == (0.0, 0)


def test_charts_escape_names() -> None:
    line = charts.Series("<b>&", [1, 10], [0.5, 0.1], 9)
    drawn = charts.error_curves([line], 'a "label"')
    assert "<b>" not in drawn and "&lt;b&gt;&amp;" in drawn and "dashed" in drawn
    assert charts.histogram([0.25, 0.75], [0.0, 15.0, 180.0], "x").count("fold") == 1


def network(lobes: int) -> Weights:
    shape = Shape(16, lobes)
    return Weights(shape, 0.5, True, initial_parameters(shape, 3).numpy())


def test_a_network_starts_from_another(kept_bake: Path, tmp_path: Path) -> None:
    """One step of no length from another network ends in that network's error, which the refusal states."""
    subject = open_subject(str(kept_bake), None, None, None)
    field = choose_texels(subject, None).field
    weights = network(5)
    (tmp_path / "w.bin").write_bytes(weights.to_bytes())
    start = warm_start(str(tmp_path / "w.bin"), 16, 5)
    settings = subject.settings.fit.model_copy(update={"steps": 1, "learning_rate": 1e-12})
    predicted = predict(replace(weights, exposure=field.exposure), field.images, field.normals)
    expected = texel_errors(as_stored(predicted), field.images, field.normals, field.exposure).log_mse
    with pytest.raises(FitFailed, match=f"ended at log_mse {expected:.4g},"):
        SOLVERS["cnn"](field, 5, settings=settings, **start.options)


def test_a_network_of_another_shape_is_refused(tmp_path: Path) -> None:
    (tmp_path / "w.bin").write_bytes(network(5).to_bytes())
    with pytest.raises(InputError, match="is for 16² pixels and 5 lobes, this fit has 32² and 8"):
        warm_start(str(tmp_path / "w.bin"), 32, 8)
    with pytest.raises(NotFound, match="no such file"):
        warm_start(str(tmp_path / "nothing"), 32, 8)


def test_fixed_directions_take_no_room(kept_bake: Path, tmp_path: Path) -> None:
    subject = open_subject(str(kept_bake), None, None, None)
    brief = partial(SOLVERS["fixed-log"], options=AdamOptions(steps=3, rate=0.2))
    solvers = {"turned": turned, "fixed": SOLVERS["fixed"], "fixed-log": brief, "sh": SOLVERS["sh"]}
    result = run(subject, plan(tmp_path, solvers))
    floats = {row.solver: row.floats_per_texel for row in result.rows}
    assert floats == {"turned": 21, "fixed": 9, "fixed-log": 9, "sh": 12}


def test_the_best_is_marked_where_there_are_rivals(kept_bake: Path, tmp_path: Path) -> None:
    subject = open_subject(str(kept_bake), None, None, None)
    result = run(subject, plan(tmp_path, {"fixed": SOLVERS["fixed"], "fixed-12": SOLVERS["fixed-12"]}))
    page = (tmp_path / "index.html").read_text()
    assert [row.lobes for row in result.rows] == [3, 12] and page.count('class="best"') == 0
    run(subject, plan(tmp_path, {"fixed": SOLVERS["fixed"], "steady": steady}))
    assert (tmp_path / "index.html").read_text().count('class="best"') == 4
