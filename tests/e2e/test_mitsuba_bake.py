"""A Mitsuba scene from its XML to a shaded package, against Mitsuba's own picture of the same file.

Mitsuba loads the file by itself (`mi.load_file`) and renders it through the `<sensor>` in it, which lightkiln ignores.
So neither the reader nor the camera is shared. The scene's left differs from its right, and its sky from both.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from e2e_farm import TINY
from in_process import Baked, bake_files

from kiln_schemas.camera import Camera
from kiln_schemas.settings import make_settings
from kiln_workers.render.backend import select_variant
from kiln_workers.scene.examples import write_exr
from kiln_workers.shade.gbuffer import render_gbuffer
from kiln_workers.shade.package import ShadePackage
from kiln_workers.shade.picture import shade

Picture = np.ndarray[Any, np.dtype[np.float64]]
SIZE = (72, 48)
EYE, TARGET, FOV = (0.6, 1.9, 6.0), (0.0, 0.9, 0.0), 40.0


def words(point: tuple[float, ...]) -> str:
    return " ".join(map(str, point))


SCENE = f"""<scene version="3.0.0">
  <default name="spin" value="75"/>
  <integrator type="path"><integer name="max_depth" value="9"/></integrator>
  <sensor type="perspective"><float name="fov" value="{FOV}"/><string name="fov_axis" value="y"/>
    <transform name="to_world"><lookat origin="{words(EYE)}" target="{words(TARGET)}" up="0 1 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="{SIZE[0]}"/><integer name="height" value="{SIZE[1]}"/>
      <rfilter type="box"/></film></sensor>
  <shape type="rectangle" id="floor"><ref id="tiles"/>
    <transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/></transform></shape>
  <shape type="instance"><ref id="blocks"/>
    <transform name="to_world"><rotate y="1" angle="20"/><translate x="-1.2"/></transform></shape>
  <shape type="shapegroup" id="blocks"><shape type="cube"><ref id="red"/>
    <transform name="to_world"><scale x="0.5" y="1.1" z="0.5"/><translate y="1.1"/></transform></shape></shape>
  <shape type="sphere"><point name="center" x="1.2" y="0.8" z="0.3"/><float name="radius" value="0.8"/><ref id="blue"/>
  </shape>
  <shape type="rectangle"><ref id="screen"/>
    <transform name="to_world"><scale x="2.6" y="1.4" z="1"/><translate y="1.4" z="-2"/></transform></shape>
  <shape type="rectangle"><emitter type="area"><spectrum name="radiance" value="400:9, 550:8, 700:5"/></emitter>
    <transform name="to_world"><scale value="0.5"/><rotate x="1" angle="90"/><translate x="-0.6" y="3.2"/></transform>
  </shape>
  <emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="0.8"/>
    <transform name="to_world"><rotate y="1" angle="$spin"/></transform></emitter>
  <bsdf type="diffuse" id="tiles"><texture type="checkerboard" name="reflectance">
    <rgb name="color0" value="0.7 0.7 0.7"/><rgb name="color1" value="0.3 0.35 0.4"/>
    <transform name="to_uv"><scale x="4" y="4"/></transform></texture></bsdf>
  <bsdf type="twosided" id="red"><bsdf type="diffuse">
    <spectrum name="reflectance" value="400:0.05, 550:0.1, 600:0.6, 700:0.7"/></bsdf></bsdf>
  <bsdf type="roughplastic" id="blue"><rgb name="diffuse_reflectance" value="0.1 0.2 0.6"/>
    <string name="distribution" value="ggx"/><float name="alpha" value="0.3"/></bsdf>
  <bsdf type="twosided" id="screen"><bsdf type="roughconductor"><string name="material" value="Al"/>
    <string name="distribution" value="ggx"/><float name="alpha" value="0.4"/></bsdf></bsdf>
</scene>"""


def sky() -> Picture:
    """Bright and warm on one side, dark and blue on the other [32, 64, 3]."""
    column = (np.arange(64) + 0.5) / 64
    warm = np.exp(-0.5 * ((column - 0.3) / 0.08) ** 2)[:, None] * [4.0, 2.5, 1.0]
    row = np.linspace(1.0, 0.25, 32)[:, None, None]
    return np.asarray(row * (warm[None] + [0.15, 0.2, 0.35]))


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Baked, Path]:
    """The bake, and a folder with the scene's files."""
    folder = tmp_path_factory.mktemp("mitsuba")
    write_exr(folder / "sky.exr", sky().astype(np.float32))
    (folder / "scene.xml").write_text(SCENE)
    files = {name: (folder / name).read_bytes() for name in ("scene.xml", "sky.exr")}
    wider = ["lightmap.resolution=96", "lightmap.tile=48", "fit.lobes=8", "render.irradiance_samples=256"]
    return bake_files(folder / "bake", files, make_settings("draft", [*TINY, *wider])), folder


@pytest.fixture(scope="module")
def pictures(baked: tuple[Baked, Path]) -> tuple[Picture, Picture]:
    """The shaded package, and Mitsuba's picture [H, W, 3]."""
    result, folder = baked
    (folder / "package").mkdir()
    result.download(folder / "package")
    select_variant("cpu")
    package = ShadePackage.read(folder / "package", torch.device("cpu"))
    camera = Camera(position=EYE, target=TARGET, fov_deg=FOV)
    ours = shade(package, render_gbuffer(package.scene, camera, *SIZE, 3, "cpu"))
    from kiln_workers.render.jit import mi

    theirs = np.array(mi.render(mi.load_file(str(folder / "scene.xml")), spp=512), dtype=np.float64)
    return ours.astype(np.float64), theirs[..., :3]


def test_what_the_bake_does_without_is_noted(baked: tuple[Baked, Path]) -> None:
    assert any("Integrator 'path' ignored" in note for note in baked[0].prepared.notes)
    assert baked[0].prepared.has_environment


def test_the_shaded_package_has_the_colours_of_mitsubas_picture(pictures: tuple[Picture, Picture]) -> None:
    ours, theirs = pictures
    ratio = ours.mean(axis=(0, 1)) / theirs.mean(axis=(0, 1))
    assert np.abs(ratio - 1.0).max() < 0.03, ratio
    for half in (slice(0, SIZE[0] // 2), slice(SIZE[0] // 2, None)):
        ratio = ours[:, half].mean(axis=(0, 1)) / theirs[:, half].mean(axis=(0, 1))
        assert np.abs(ratio - 1.0).max() < 0.05, ratio


def test_left_is_left(pictures: tuple[Picture, Picture]) -> None:
    """It is far nearer to Mitsuba's picture than the mirrored one, and so is the sky alone."""
    ours, theirs = (np.log(picture + 0.02) for picture in pictures)
    error, mirrored = ((ours - other) ** 2 for other in (theirs, theirs[:, ::-1]))
    assert error.mean() < 0.05 * mirrored.mean(), (error.mean(), mirrored.mean())
    assert error[:8].mean() < 0.05 * mirrored[:8].mean(), (error[:8].mean(), mirrored[:8].mean())
