"""Cameras in and pictures out: the two commands, their errors, and the files of a package read back."""

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from kiln_schemas.camera import read_camera
from kiln_schemas.errors import InputError
from kiln_workers.__main__ import main
from kiln_workers.package.exr import write_rgb
from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.model import Scene
from kiln_workers.shade.camera import pixel_directions
from kiln_workers.shade.package import ShadePackage, read_exr

CAMERA = "--camera=0.4,0.9,2.6:0,0.35,-0.4:45"


def test_cameras(tmp_path: Path) -> None:
    camera = read_camera("-1,2,3.5:0,0,-4:40")
    assert camera.position == (-1.0, 2.0, 3.5) and camera.target == (0.0, 0.0, -4.0) and camera.fov_deg == 40.0
    file = tmp_path / "camera.json"
    file.write_text(camera.model_dump_json())
    assert read_camera(str(file)) == camera
    ahead = pixel_directions(read_camera("0,0,0:0,0,-5:90"), 3, 3, 1)[:, :, 0]
    np.testing.assert_allclose(ahead[1, 1], [0, 0, -1], atol=1e-12)
    assert ahead[1, 2, 0] > 0.0 and ahead[0, 1, 1] > 0.0  # right is +X, the first row is the top
    np.testing.assert_allclose(np.degrees(np.arctan(ahead[0, 1, 1] / -ahead[0, 1, 2])), np.degrees(np.arctan(2 / 3)))


@pytest.mark.parametrize(
    "text",
    ["1,2:0,0,0:40", "1,2,3:0,0,0:0", "1,2,3:1,2,3:40", "0,0,0:0,1,0:40", "nan,0,0:0,0,1:40", "a,b,c:0,0,1:40", "none"],
)
def test_bad_cameras(text: str) -> None:
    with pytest.raises(InputError) as caught:
        read_camera(text)
    assert text in str(caught.value)


def test_a_package_is_read_as_it_was_made(package_folder: Path, make_package) -> None:
    read, made = ShadePackage.read(package_folder, torch.device("cpu")), make_package(environment=True)
    assert read.environment is not None and made.environment is not None
    torch.testing.assert_close(read.irradiance, made.irradiance)
    torch.testing.assert_close(read.lobes.light_field, made.lobes.light_field, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(read.environment.u, made.environment.u, rtol=1e-3, atol=0.0)
    torch.testing.assert_close(read.environment.itself, made.environment.itself)
    for ours, theirs in zip(read.scene.meshes, made.scene.meshes, strict=True):
        assert ours.lightmap_uv is not None and theirs.lightmap_uv is not None
        np.testing.assert_array_equal(ours.lightmap_uv[ours.faces], theirs.lightmap_uv[theirs.faces])


def test_shade_writes_what_it_says(package_folder: Path, tmp_path: Path, capfd) -> None:
    command = ["shade", str(package_folder), CAMERA, "--size=32x20", "--grid=1", "--device=cpu", "--json"]
    picture, again = tmp_path / "a.exr", tmp_path / "b.png"
    assert main([*command, "-o", str(picture)]) == 0
    told = json.loads(capfd.readouterr().out)
    assert (told["width"], told["height"], told["source"]) == (32, 20, "textures") and "psnr" not in told
    assert read_exr(picture).shape == (20, 32, 3) and read_exr(picture).max() > 3.0
    assert main([*command, "-o", str(again), "--against", str(picture)]) == 0
    told = json.loads(capfd.readouterr().out)
    assert (told["psnr"], told["ssim"], told["flip"]) == (None, 1.0, 0.0)  # nothing differs
    assert oiio.ImageInput.open(str(again)).spec().nchannels == 3
    darker = tmp_path / "darker.exr"
    write_rgb(darker, 0.9 * read_exr(picture))
    assert main([*command, "-o", str(again), "--against", str(darker)]) == 0
    told = json.loads(capfd.readouterr().out)
    assert 20.0 < told["psnr"] < 45.0 and 0.5 < told["ssim"] < 1.0 and 0.0 < told["flip"] < 0.5


def test_terms_add_up(package_folder: Path, tmp_path: Path, capfd) -> None:
    parts = ["emission", "diffuse", "interreflection", "environment", "background"]
    pictures = {}
    for terms in (",".join(parts), *parts):
        out = tmp_path / "part.exr"
        base = ["shade", str(package_folder), CAMERA, "--size=24x15", "--grid=1", "--device=cpu", "-o", str(out)]
        assert main([*base, "--terms", terms]) == 0
        pictures[terms] = read_exr(out)
    capfd.readouterr()
    assert all(pictures[part].max() > 0.0 for part in parts)
    np.testing.assert_allclose(sum(pictures[part] for part in parts), pictures[",".join(parts)], rtol=1e-4, atol=1e-5)


def test_reference_states_its_noise(lit_room: Scene, tmp_path: Path, capfd) -> None:
    scene, sky, out = tmp_path / "room.glb", tmp_path / "sky.exr", tmp_path / "r.exr"
    scene.write_bytes(encode_glb(lit_room))
    assert lit_room.environment is not None
    write_rgb(sky, lit_room.environment.pixels)
    noise = {}
    for samples in (16, 256):
        command = ["reference", str(scene), CAMERA, "--env", str(sky), "--size=24x15", f"--samples={samples}"]
        assert main([*command, "-o", str(out), "--device=cpu", "--json"]) == 0
        told = json.loads(capfd.readouterr().out)
        assert told["samples"] == samples and read_exr(out).shape == (15, 24, 3)
        noise[samples] = told["rms_noise"]
    # Sixteen times the paths, a quarter of the noise.
    assert 2.0 < noise[16] / noise[256] < 8.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--size=0x20", "-o", "a.exr"], "not a size"),
        (["--size=32x20", "-o", "a.jpg"], "'.jpg' is not a format"),
        (["--size=32x20", "-o", "a.exr", "--terms=colour"], "'colour' is refused"),
        (["--size=32x20", "-o", "a.exr", "--stored=/nowhere"], "no light-field store"),
    ],
)
def test_shade_refuses(package_folder: Path, arguments: list[str], words: str, capfd, monkeypatch) -> None:
    monkeypatch.chdir(package_folder.parent)
    assert main(["shade", str(package_folder), CAMERA, "--device=cpu", *arguments]) == 3
    assert words in capfd.readouterr().err
    assert not (package_folder.parent / "a.exr").exists()


def test_no_package_and_no_scene(tmp_path: Path, capfd) -> None:
    assert main(["shade", str(tmp_path), CAMERA, "-o", str(tmp_path / "a.png")]) == 3
    assert "no package" in capfd.readouterr().err
    assert main(["reference", str(tmp_path / "no.glb"), CAMERA, "-o", str(tmp_path / "a.png")]) == 3
    assert "no such file" in capfd.readouterr().err
