"""The denoiser: it removes noise and keeps the light, its pictures are marked, and no measurement takes one."""

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from kiln_schemas.camera import Camera
from kiln_schemas.errors import InputError
from kiln_workers.__main__ import main
from kiln_workers.package import exr
from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.model import Scene
from kiln_workers.shade import denoise
from kiln_workers.shade.package import DENOISED, read_exr
from kiln_workers.shade.reference import ReferenceTracer

CAMERA = "--camera=0.4,0.9,2.6:0,0.35,-0.4:45"

pytest.importorskip("pyoidn", reason="the denoiser has no wheel for this machine")


def test_it_comes_closer_to_the_converged_picture(room_scene: Scene) -> None:
    """Two small lamps light a room: noise of the light itself."""
    camera = Camera(position=(0.4, 0.9, 2.6), target=(0.0, 0.35, -0.4), fov_deg=45.0)
    tracer = ReferenceTracer(room_scene, camera, 96, 60, 4, "cpu")
    wanted, noisy = tracer.render(1024, seed=5).picture, tracer.render(2).picture
    clean = denoise.denoised(noisy, *tracer.guides())
    lit = (wanted.max(axis=-1) > 0.0) & (wanted.max(axis=-1) < 0.2)  # neither lamps nor nothing
    before, after = (np.sqrt(np.mean((picture - wanted)[lit] ** 2)) for picture in (noisy, clean))
    assert after < 0.6 * before
    np.testing.assert_allclose(clean[lit].mean(axis=0), wanted[lit].mean(axis=0), rtol=0.1)


def test_guides_are_base_colours_and_normals(room_scene: Scene) -> None:
    camera = Camera(position=(0.0, 2.0, 0.0), target=(0.0, 0.0, 0.0), fov_deg=20.0, up=(0.0, 0.0, -1.0))
    albedo, normal = ReferenceTracer(room_scene, camera, 8, 8, 1, "cpu").guides()
    np.testing.assert_allclose(albedo[4, 4], [0.9, 0.7, 0.3], rtol=1e-5)  # brass, a metal
    np.testing.assert_allclose(normal[4, 4], [0.0, 1.0, 0.0], atol=1e-6)


def test_no_measurement_takes_a_denoised_picture(lit_room: Scene, package_folder: Path, tmp_path: Path, capfd) -> None:
    scene, picture, out = tmp_path / "room.glb", tmp_path / "clean.exr", tmp_path / "shaded.exr"
    scene.write_bytes(encode_glb(lit_room))
    command = ["reference", str(scene), CAMERA, "--size=32x20", "--samples=8", "--device=cpu", "--denoise"]
    assert main([*command, "-o", str(picture), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["denoised"]
    shading = ["shade", str(package_folder), CAMERA, "--size=32x20", "--grid=1", "--device=cpu", "-o", str(out)]
    assert main([*shading, "--against", str(picture)]) == 3
    problem = capfd.readouterr().err
    assert "is a denoised picture, which is for looking only" in problem and "without --denoise" in problem
    assert not out.exists()
    with pytest.raises(InputError, match="denoised"):
        read_exr(picture)
    # The same picture without the mark is read: the mark, and nothing else, is what is refused.
    exr.write_rgb(out, np.zeros((20, 32, 3), np.float32))
    assert main([*shading, "--against", str(out)]) == 0
    # A PNG is marked too.
    assert main([*command, "-o", str(tmp_path / "clean.png")]) == 0
    assert "all figures are of the picture before that" in capfd.readouterr().out
    assert oiio.ImageInput.open(str(tmp_path / "clean.png")).spec().getattribute(DENOISED) is not None
    assert main([*command[:-1], "-o", str(tmp_path / "noisy.png")]) == 0
    assert oiio.ImageInput.open(str(tmp_path / "noisy.png")).spec().getattribute(DENOISED) is None


def test_without_the_library_a_sentence_says_so(monkeypatch, tmp_path: Path, capfd) -> None:
    monkeypatch.setattr(denoise, "find_spec", lambda name: None)
    command = ["reference", str(tmp_path / "room.glb"), CAMERA, "-o", str(tmp_path / "a.png"), "--denoise"]
    assert main(command) == 7
    assert "pip install 'lightkiln[denoise]'" in capfd.readouterr().err
