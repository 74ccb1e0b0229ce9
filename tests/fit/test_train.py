"""Whole fits on small data: recovery, collapse, no signal, threads, kill -9 and resume, prediction, metrics."""

import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from kiln_schemas.conventions import EXPOSURE_KEY
from kiln_schemas.errors import FitFailed, InputError
from kiln_schemas.settings import FitSettings, Function
from kiln_schemas.tasks import Progress
from kiln_workers.fit.metrics import exposure_of, texel_errors
from kiln_workers.fit.network import Shape, initial_parameters
from kiln_workers.fit.predict import Weights, predict
from kiln_workers.fit.source import ArraySource
from kiln_workers.fit.train import train
from kiln_workers.fit.verdict import failure, is_negligible
from kiln_workers.sphere import gaussian, octahedral

SHORT = FitSettings(lobes=4, steps=40, batch=10, window=24)
LIGHT = Function.LIGHT_FIELD


def test_lobes_are_recovered_from_a_scene_made_of_lobes(lobe_source: ArraySource) -> None:
    seen: list[Progress] = []
    settings = FitSettings(lobes=4, steps=300, batch=16)
    outcome = train(lobe_source, settings, LIGHT, 0, threads=2, on_progress=seen.append)
    assert outcome.metrics.log_mse_rel < 0.01 and outcome.metrics.texels == 40 and outcome.metrics.signal
    assert [p.done for p in seen] == list(range(1, 301)) and seen[-1].loss is not None
    assert outcome.curve[-1].step == outcome.steps == 300 and len(outcome.curve) == 300
    assert outcome.curve[-1].loss < 0.2 * outcome.curve[0].loss
    # The reported error is the error of the rounded lobes of `predict`, recomputed slowly from its definition.
    tiles = range(len(lobe_source.counts))
    images = np.concatenate([lobe_source.images(t, np.arange(lobe_source.counts[t])) for t in tiles])
    normals = np.concatenate([lobe_source.normals(t) for t in tiles])
    lobes = predict(outcome.weights, images, normals).astype(np.float16)
    error, zero = slow_log_mse(lobes.astype(np.float64), images, normals, outcome.exposure)
    assert outcome.metrics.log_mse == pytest.approx(error, rel=1e-3)
    assert outcome.metrics.log_mse_zero == pytest.approx(zero, rel=1e-4)


def slow_log_mse(lobes: np.ndarray, images: np.ndarray, normals: np.ndarray, exposure: float) -> tuple[float, float]:
    """docs/mathematics.md, pixel by pixel; also that of P = 0."""
    size = images.shape[1]
    directions, angles = octahedral.pixel_directions(size), octahedral.pixel_solid_angles(size)
    error = zero = weight = 0.0
    for lobe, image, normal in zip(lobes, images.astype(np.float64), normals.astype(np.float64), strict=True):
        for row in range(size):
            for column in range(size):
                if directions[row, column] @ normal <= 0.0:
                    continue
                predicted = gaussian.evaluate(directions[row, column][None], lobe)[0]
                target = np.log1p(exposure * image[row, column])
                error += angles[row, column] * ((target - np.log1p(exposure * predicted)) ** 2).sum()
                zero += angles[row, column] * (target**2).sum()
                weight += 3.0 * angles[row, column]
    return error / weight, zero / weight


def test_the_error_of_random_lobes_is_the_slow_loops() -> None:
    rng = np.random.default_rng(2)
    images = (rng.random((3, 16, 16, 3)) * 4.0).astype(np.float16)
    normals = np.array([[0, 0, 1], [1, 0, 0], [0.6, -0.8, 0]], np.float32)
    lobes = np.concatenate([rng.standard_normal((3, 5, 3)), 1.0 + 30.0 * rng.random((3, 5, 4))], axis=-1)
    lobes[..., :3] /= np.linalg.norm(lobes[..., :3], axis=-1, keepdims=True)
    errors = texel_errors(lobes.astype(np.float32), images, normals, 0.7)
    error, zero = slow_log_mse(lobes, images, normals, 0.7)
    assert errors.log_mse == pytest.approx(error, rel=1e-4)
    assert errors.log_mse_zero == pytest.approx(zero, rel=1e-5)
    assert errors.log_mse_rel == pytest.approx(error / zero, rel=1e-4)


def test_exposure_brings_the_mean_above_the_horizon_to_the_key() -> None:
    images = np.zeros((2, 16, 16, 3), np.float16)
    images[...] = [2.0, 1.0, 0.5]
    images[:, octahedral.pixel_directions(16)[..., 1] <= 0.0] = 7.0  # below the horizon: not counted
    source = ArraySource(images, np.tile(np.float32([0, 1, 0]), (2, 1)))
    luminance = 0.2126 * 2.0 + 0.7152 + 0.0722 * 0.5
    assert exposure_of(source, LIGHT) == pytest.approx(0.18 / luminance, rel=1e-6)
    assert exposure_of(source, Function.VISIBILITY) == 1.0


def test_the_scale_of_the_scene_does_not_matter(lobe_source: ArraySource) -> None:
    brighter = ArraySource(lobe_source._images * np.float16(64.0), lobe_source._normals, tile=16)
    outcomes = [train(source, SHORT, LIGHT, 0) for source in (lobe_source, brighter)]
    assert outcomes[0].exposure == pytest.approx(64.0 * outcomes[1].exposure, rel=1e-6)
    assert outcomes[0].metrics.log_mse_rel == pytest.approx(outcomes[1].metrics.log_mse_rel, rel=1e-2)


def test_a_fit_that_collapses_fails_with_its_numbers(lobe_source: ArraySource) -> None:
    with pytest.raises(FitFailed, match=r"ended at log_mse .* of the .* no light at all") as caught:
        train(lobe_source, FitSettings(lobes=4, steps=40, batch=10, learning_rate=1.0), LIGHT, 0)
    assert "fit.steps (now 40)" in (caught.value.remedy or "") and caught.value.where == "fit light_field"


def test_the_remedy_of_a_failure_fits_its_cause() -> None:
    """Too few texels, hardly any light, or a fit that did not come far enough."""

    def remedy(texels: int, signal: float) -> str:
        errors = SimpleNamespace(error=np.ones(texels), log_mse=signal, log_mse_zero=signal, log_mse_rel=1.0)
        return failure(errors, LIGHT, "steps", 40, 4).remedy or ""  # type: ignore[arg-type]

    assert remedy(3, 1.0).startswith("Only 3 texels of the light map can be fitted: raise lightmap.resolution")
    assert remedy(500, 1e-9).startswith("Hardly any light reaches the surfaces")
    assert remedy(500, 1.0).startswith("Raise fit.steps (now 40) or fit.lobes (now 4)")


def test_darkness_is_no_failure(lobe_source: ArraySource) -> None:
    dark = ArraySource(np.zeros_like(lobe_source._images), lobe_source._normals)
    for function in Function:
        outcome = train(dark, SHORT, function, 0)
        assert not outcome.metrics.signal and outcome.metrics.log_mse_rel == 0.0 and outcome.steps == 0
        lobes = predict(outcome.weights, dark._images[:3], dark._normals[:3])
        assert lobes.shape == (3, 4, 7) and (lobes[..., 4:] == 0.0).all() and (lobes[..., 3] > 0.0).all()


def test_a_fit_that_collapses_on_what_nobody_would_see_is_left_out(lobe_source: ArraySource) -> None:
    settings = FitSettings(lobes=4, steps=40, batch=10, learning_rate=1.0)
    received = np.full((3, 3), np.pi * EXPOSURE_KEY / exposure_of(lobe_source, LIGHT), np.float32)
    with pytest.raises(FitFailed):
        train(lobe_source, settings, LIGHT, 0, is_negligible=lambda exposure: is_negligible(exposure, 99.0 * received))
    outcome = train(
        lobe_source, settings, LIGHT, 0, is_negligible=lambda exposure: is_negligible(exposure, 101.0 * received)
    )
    assert not outcome.metrics.signal and outcome.metrics.log_mse == outcome.metrics.log_mse_zero > 0.0
    lobes = predict(outcome.weights, lobe_source._images[:3], lobe_source._normals[:3])
    assert (lobes[..., 4:] == 0.0).all()
    assert train(lobe_source, SHORT, LIGHT, 0, is_negligible=lambda _: True).metrics.signal, "what can be fitted is"


def test_no_valid_texel_is_an_error() -> None:
    empty = ArraySource(np.zeros((0, 16, 16, 3), np.float16), np.zeros((0, 3), np.float32))
    with pytest.raises(InputError, match="no texel of the light map is valid"):
        train(empty, SHORT, LIGHT, 0)


def test_threads_do_not_change_a_byte(lobe_source: ArraySource) -> None:
    outcomes = [train(lobe_source, SHORT, LIGHT, 5, threads=threads) for threads in (1, 2, 3)]
    assert outcomes[0].weights == outcomes[1].weights == outcomes[2].weights
    assert outcomes[0].metrics == outcomes[2].metrics and outcomes[0].curve == outcomes[2].curve
    assert train(lobe_source, SHORT, LIGHT, 6).weights != outcomes[0].weights


def test_the_callers_number_of_torch_threads_comes_back(lobe_source: ArraySource) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        train(lobe_source, SHORT, LIGHT, 5)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_every_checkpoint_resumes_to_the_same_bytes(lobe_source: ArraySource) -> None:
    saved: list[bytes] = []
    whole = train(lobe_source, SHORT, LIGHT, 1, on_checkpoint=saved.append, checkpoint_every_s=0.0)
    assert len(saved) == SHORT.steps - 1
    for step in (1, 2, 19, 39):
        resumed = train(lobe_source, SHORT, LIGHT, 1, threads=2, checkpoint=saved[step - 1])
        assert resumed.weights == whole.weights
        assert resumed.metrics == whole.metrics and resumed.curve == whole.curve
    with pytest.raises(InputError, match="belongs to another fit"):
        train(lobe_source, SHORT, LIGHT, 2, checkpoint=saved[0])


_RESUMABLE = """
import sys, time
from pathlib import Path
from types import SimpleNamespace
sys.path.insert(0, sys.argv[1])
from conftest import made_of_lobes
from kiln_schemas.settings import FitSettings, Function
from kiln_workers.fit.source import ArraySource
from kiln_workers.fit.train import train
folder = Path(sys.argv[2])
last = folder / "checkpoint"

def save(data):
    (folder / "new").write_bytes(data)
    (folder / "new").replace(last)
    print("saved", flush=True)
    time.sleep(0.01)

settings = FitSettings(lobes=4, steps=40, batch=10, window=24)
outcome = train(ArraySource(*made_of_lobes(40), tile=16), settings, Function.LIGHT_FIELD, 1,
                checkpoint=last.read_bytes() if last.exists() else None, on_checkpoint=save, checkpoint_every_s=0.0)
(folder / "weights").write_bytes(outcome.weights)
"""


def test_a_fit_killed_twice_ends_in_the_same_bytes(lobe_source: ArraySource, tmp_path: Path) -> None:
    command = [sys.executable, "-c", _RESUMABLE, str(Path(__file__).parent), str(tmp_path)]
    for saves in (7, 16):
        with subprocess.Popen(command, stdout=subprocess.PIPE) as fit:
            assert fit.stdout is not None
            for _ in range(saves):
                assert fit.stdout.readline() == b"saved\n"
            fit.send_signal(signal.SIGKILL)
        assert not (tmp_path / "weights").exists()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert (tmp_path / "weights").read_bytes() == train(lobe_source, SHORT, LIGHT, 1).weights


def test_prediction_does_not_depend_on_how_texels_are_grouped(lobe_source: ArraySource) -> None:
    shape = Shape(16, 5)
    parameters = initial_parameters(shape, 1).numpy() * 5.0
    weights = Weights(shape, 0.25, True, parameters)
    images, normals = lobe_source._images, lobe_source._normals
    together = predict(weights, images, normals, threads=2)
    apart = np.concatenate(
        [predict(weights.to_bytes(), images[i : i + 3], normals[i : i + 3]) for i in range(0, 40, 3)]
    )
    assert together.tobytes() == apart.tobytes()
    assert together.dtype == np.float32 and together.shape == (40, 5, 7)
    np.testing.assert_allclose(np.linalg.norm(together[..., :3], axis=-1), 1.0, atol=1e-5)
    quarter = predict(Weights(shape, 0.25, True, parameters), images, normals)
    darker = predict(Weights(shape, 0.25, False, parameters), images, normals)
    np.testing.assert_array_equal(quarter[..., :4], darker[..., :4])
    assert quarter[..., 4:].min() > 0.0


def test_weights_of_another_network_are_refused() -> None:
    weights = Weights(Shape(16, 5), 1.0, True, np.zeros(7, np.float32))
    with pytest.raises(InputError, match="weights"):
        Weights.from_bytes(weights.to_bytes())
