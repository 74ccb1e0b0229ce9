"""Adaptive sampling of the reference: it reaches its noise, spends paths where they count, and has no bias."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiln_schemas.camera import Camera
from kiln_workers.__main__ import main
from kiln_workers.package import colour
from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.model import Scene
from kiln_workers.shade import adaptive, sampling_line
from kiln_workers.shade.adaptive import AdaptiveSampler, Progress, measured_noise, noise_of_luminance
from kiln_workers.shade.reference import ReferenceTracer

CAMERA = Camera(position=(0.4, 0.9, 2.6), target=(0.0, 0.35, -0.4), fov_deg=45.0)


class Coin:
    """A tracer whose paths are rarely lit: 1 / p with probability p, so that the mean is 1 everywhere."""

    def __init__(self, size: tuple[int, int], chance: float) -> None:
        self.size, self._chance = size, chance

    def sample(self, pixels: np.ndarray, seed: int) -> np.ndarray:
        lit = np.random.default_rng(seed).random(len(pixels)) < self._chance
        return np.repeat((lit / self._chance)[:, None], 3, axis=1).astype(np.float32)


def test_the_noise_is_that_of_the_display() -> None:
    """Steps of sqrt(Y / W) and, beyond white, of 1 + ln(Y / W) / 2."""
    white, y = 3.0, np.array([0.02, 0.5, 2.9, 3.1, 40.0])
    step = 1e-6
    shown = [np.where(v < white, np.sqrt(v / white), 1.0 + 0.5 * np.log(v / white)) for v in (y - step, y + step)]
    np.testing.assert_allclose(noise_of_luminance(y, white), (shown[1] - shown[0]) / (2.0 * step), rtol=1e-4)
    dark = noise_of_luminance(np.array([0.0, white / 256.0]), white)
    assert dark[0] == dark[1] == pytest.approx(8.0 / white)


def test_every_tile_reaches_the_noise_and_none_has_many_more_paths(lit_room: Scene) -> None:
    tracer = ReferenceTracer(lit_room, CAMERA, 44, 30, 4, "cpu")
    found = AdaptiveSampler(tracer, 0.008, 4096).run()
    assert found.reached
    assert found.tile_noise.max() <= 0.008
    assert found.paths.min() < 0.3 * found.paths.max()
    # Two independent ways to the same figure: variances of the paths, and the difference of the halves.
    whole = np.sqrt(np.mean(found.tile_noise**2))
    white = colour.white_point(found.reference.picture)
    assert measured_noise(found.reference, white) == pytest.approx(whole, rel=0.15)
    bound = AdaptiveSampler(tracer, 0.002, 64).run()
    assert bound.paths.max() == 64 and not bound.reached and bound.tile_noise.max() > 0.002


def test_fewer_paths_than_uniform_sampling_for_the_same_worst_tile(lit_room: Scene) -> None:
    tracer = ReferenceTracer(lit_room, CAMERA, 44, 30, 4, "cpu")
    found = AdaptiveSampler(tracer, 0.008, 4096).run()
    uniform = AdaptiveSampler(tracer, 1e-4, int(found.paths.mean())).run()
    assert np.ptp(uniform.paths) == 0
    assert found.tile_noise.max() < 0.75 * uniform.tile_noise.max()


def test_the_same_bytes_for_the_same_inputs(lit_room: Scene) -> None:
    def picture(seed: int) -> bytes:
        tracer = ReferenceTracer(lit_room, CAMERA, 44, 30, 4, "cpu")
        return AdaptiveSampler(tracer, 0.01, 1024, seed).run().reference.picture.tobytes()

    assert picture(7) == picture(7) != picture(8)


def test_passes_do_not_change_which_pixels_are_sampled(lit_room: Scene, monkeypatch) -> None:
    """Wavefronts that end amid a pixel give each pixel its number of paths all the same."""
    tracer = ReferenceTracer(lit_room, CAMERA, 44, 30, 4, "cpu")
    monkeypatch.setattr(adaptive, "LANES", 1000)
    found = AdaptiveSampler(tracer, 1e-4, 6).run()
    assert (found.paths == 6).all() and (found.scouts == adaptive.FIRST).all()
    wanted = tracer.render(512).picture
    np.testing.assert_allclose(found.reference.picture.mean(axis=(0, 1)), wanted.mean(axis=(0, 1)), rtol=0.05)


@pytest.mark.parametrize("chance", [0.05, 0.2])
def test_stopping_does_not_bias_the_mean(chance: float) -> None:
    """Pictures of one pixel that few paths find, the hardest case; its mean is 1.

    Where the first 16 paths all miss, nothing says that more are needed. With the scouts' paths in the picture it was
    34 % too dark at a chance of 0.05, and 16 % with two halves that decide on each other's number.
    """
    found = [AdaptiveSampler(Coin((1, 1), chance), 0.1, 512, seed).run() for seed in range(3000)]
    means = np.array([one.reference.picture.mean(dtype=np.float64) for one in found])
    error = means.std(ddof=1) / np.sqrt(len(means))
    assert error < 0.02
    assert abs(means.mean() - 1.0) < 4.0 * error
    assert len({int(one.paths.max()) for one in found}) > 2
    # The halves tell the true spread of the picture.
    halves = np.array([one.reference.halves for one in found])[:, :, 0, 0, 0].astype(np.float64)
    spread = np.mean((0.5 * (halves[:, 0] - halves[:, 1])) ** 2)
    assert spread == pytest.approx(means.var(ddof=1), rel=0.15)


def test_the_mean_of_many_seeds_is_the_converged_picture(lit_room: Scene) -> None:
    """Real paths: tile by tile, the adaptive mean of 12 seeds against uniform paths, in standard errors."""
    tracer = ReferenceTracer(lit_room, CAMERA, 24, 16, 4, "cpu")
    wanted = tracer.render(4096, seed=999)
    seeds = [AdaptiveSampler(tracer, 0.012, 1024, seed).run().reference.picture for seed in range(12)]
    pictures = np.array([adaptive._by_tile(colour.luminance(picture.astype(np.float64))) for picture in seeds])
    halves = [adaptive._by_tile(colour.luminance(half.astype(np.float64))) for half in wanted.halves]
    error = np.hypot(pictures.std(axis=0, ddof=1) / np.sqrt(len(pictures)), 0.5 * (halves[0] - halves[1]))
    z = (pictures.mean(axis=0) - 0.5 * (halves[0] + halves[1])) / np.maximum(error, 1e-4 * halves[0])
    assert np.abs(z).max() < 5.0 and abs(z.mean()) < 4.0 / np.sqrt(z.size)


def test_the_command_states_what_it_reached(lit_room: Scene, tmp_path: Path, capfd) -> None:
    scene, out = tmp_path / "room.glb", tmp_path / "r.exr"
    scene.write_bytes(encode_glb(replace(lit_room, environment=None)))
    command = [
        "reference",
        str(scene),
        "--camera=0.4,0.9,2.6:0,0.35,-0.4:45",
        "--size=40x24",
        "-o",
        str(out),
        "--device=cpu",
    ]
    assert main([*command, "--noise=0.01", "--max-samples=2048", "--json"]) == 0
    captured = capfd.readouterr()
    result = json.loads(captured.out)
    assert result["noise_reached"] and result["noise"] <= 0.01 and result["noise_asked"] == 0.01
    assert 16 <= result["samples"] <= result["most_samples"] <= 2048
    assert "million paths" in captured.err
    assert main([*command, "--noise=0.001", "--max-samples=32"]) == 0
    assert "of the picture has more with 32 paths a pixel at most" in capfd.readouterr().out
    with pytest.raises(SystemExit):
        main([*command, "--noise=2"])


def test_progress_is_one_line_on_a_terminal(monkeypatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr(sampling_line.sys, "stderr", terminal)
    with sampling_line.SamplingLine(0.02) as line:
        line.show(Progress(0.041, 3_000_000, 17_000_000, 95.0))
        line.show(Progress(0.025, 12_000_000, 7_000_000, 30.0))
    shown = terminal.getvalue()
    assert "3.0 of about 20.0 million paths, about 1:35 left" in shown
    assert shown.count("\n") == 1 and shown.endswith("0:30 left\n")
