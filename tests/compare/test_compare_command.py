"""The command on a small kept bake: figures recomputed by other means, its files, what it keeps, what it refuses."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from kiln_schemas.errors import InputError
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Tile
from kiln_workers.__main__ import main
from kiln_workers.compare.subject import open_subject
from kiln_workers.compare.texels import ChosenTexels, choose_texels
from kiln_workers.fit.solvers import SOLVERS
from kiln_workers.scene.container import unpack
from kiln_workers.shade.image_metrics import flip, psnr
from kiln_workers.sphere import octahedral

CAMERA = {"eye": {"position": [0.4, 0.9, 2.6], "target": [0.0, 0.35, -0.4], "fov_deg": 45}}


@pytest.fixture(scope="module")
def compared(kept_bake: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of one comparison."""
    out = tmp_path_factory.mktemp("out")
    cameras = out / "cameras.json"
    cameras.write_text(json.dumps(CAMERA))
    assert main(arguments(kept_bake, out)) == 0
    return out


def arguments(bake: Path, out: Path) -> list[str]:
    return [
        *("compare", str(bake), "--out", str(out), "--solvers", "fixed,sh", "--lobes", "4,6", "--between", "20"),
        *("--cameras", str(out / "cameras.json"), "--size", "48x32", "--reference-samples", "4", "--stored"),
        *("--threads", "1", "--json"),
    ]


@pytest.fixture(scope="module")
def texels(kept_bake: Path) -> ChosenTexels:
    return choose_texels(open_subject(str(kept_bake), None, None, None), None)


def rows(out: Path) -> dict[tuple[str, int], dict[str, object]]:
    document = json.loads((out / "compare.json").read_text())
    return {(row["solver"], row["lobes"]): row for row in document["rows"]}


def log_mse(lobes: np.ndarray, images: np.ndarray, normals: np.ndarray, exposure: float) -> tuple[float, float]:
    """log_mse and that of P = 0, texel by texel in double precision, as docs/mathematics.md defines it."""
    size = images.shape[1]
    directions = octahedral.pixel_directions(size).reshape(-1, 3)
    solid_angles = octahedral.pixel_solid_angles(size).reshape(-1)
    error = zero = weight = 0.0
    for lobe, image, normal in zip(lobes.astype(np.float64), images, normals, strict=True):
        values = np.exp(lobe[:, 3] * (directions @ lobe[:, :3].T - 1.0)) @ lobe[:, 4:]
        target = np.log1p(image.reshape(-1, 3).astype(np.float64) * exposure)
        w = np.where(directions @ normal > 0.0, solid_angles, 0.0)[:, None]
        error += float((w * (np.log1p(values) - target) ** 2).sum()) / 3.0
        zero += float((w * target**2).sum()) / 3.0
        weight += float(w.sum())
    return error / weight, zero / weight


def test_errors_are_those_of_an_independent_computation(compared: Path, texels: ChosenTexels) -> None:
    field = texels.field
    lobes = SOLVERS["fixed"](field, 6).representation.parameters.numpy().astype(np.float16).astype(np.float64)
    row = rows(compared)["fixed", 6]
    error, zero = log_mse(lobes, field.images, field.normals, field.exposure)
    assert row["log_mse"] == pytest.approx(error, rel=1e-4)
    assert row["floats_per_texel"] == 3 * 6  # directions and sharpness are common to all texels
    assert row["log_mse_rel"] == pytest.approx(error / zero, rel=1e-4)
    (path,) = (compared / "cache").glob("between-*.bin")
    traced = unpack("between", path.read_bytes())[1]
    mixed = lobes[traced["corners"]].mean(axis=1)
    mixed[..., :3] /= np.linalg.norm(mixed[..., :3], axis=-1, keepdims=True)
    targets = 0.5 * (traced["first"].astype(np.float32) + traced["second"])
    between, _ = log_mse(mixed, targets, traced["normals"], field.exposure)
    assert len(mixed) > 40
    assert row["log_mse_between"] == pytest.approx(between, rel=2e-3)  # targets are kept in fp16
    assert row["interp_ratio"] == pytest.approx(between / error, rel=2e-3)


def test_the_field_is_what_the_store_holds(kept_bake: Path, texels: ChosenTexels) -> None:
    subject = open_subject(str(kept_bake), None, None, None)
    row, column = texels.field.place[100]
    tile = Tile(row=row // 8 * 8, column=column // 8 * 8, size=8, texels=1)
    image = subject.store.read_tile(Function.LIGHT_FIELD, tile, np.array([row % 8 * 8 + column % 8]))[0]
    np.testing.assert_array_equal(texels.field.images[100], image)
    assert len(texels.field) == 144 and texels.whole
    part = choose_texels(subject, 2)
    assert 0 < len(part.field) < 144 and not part.whole


def test_pictures_are_scored_against_the_reference(compared: Path) -> None:
    (path,) = (compared / "cache").glob("reference-*.bin")
    halves = unpack("reference", path.read_bytes())[1]
    reference = 0.5 * (halves["first"] + halves["second"])
    pictures = [unpack("picture", p.read_bytes())[1]["picture"] for p in (compared / "cache").glob("picture-*.bin")]
    flips = sorted(flip(reference, np.array(picture)) for picture in pictures)
    document = json.loads((compared / "compare.json").read_text())
    whole = [s for row in document["rows"] for s in row["images"] if s["alpha"] is None]
    whole += [s for s in document["cameras"][0]["stored"] if s["alpha"] is None]
    assert len(whole) == 3  # two of `fixed`, the stored light field; harmonics have no lobes to shade from
    assert sorted(score["flip"] for score in whole) == pytest.approx(flips, abs=1e-5)
    assert all(score["psnr"] > 5.0 for score in whole)
    assert {score["alpha"] for score in document["rows"][0]["images"]} == {None, 0.3, 1.0}
    assert psnr(reference, reference, 1.0) == float("inf")
    assert (compared / "pictures" / "eye-fixed-6.png").stat().st_size > 500


def test_tables_hold_every_row(compared: Path) -> None:
    found = rows(compared)
    assert set(found) == {("fixed", 4), ("fixed", 6), ("sh", 4), ("sh", 6)}
    with (compared / "compare.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(line["solver"], int(line["lobes"])) for line in lines] == list(found)
    for line in lines:
        row = found[line["solver"], int(line["lobes"])]
        assert float(line["log_mse_between"]) == row["log_mse_between"]
        assert {"scene", "solver", "lobes", "log_mse", "log_mse_between", "seconds_per_texel"} <= set(line)
    page = (compared / "index.html").read_text()
    for solver, lobes in found:
        assert f"{solver}, {lobes} lobes" in page
    assert page.count("<tr") > 8 and "http" not in page.replace("http-equiv", "")


def test_a_second_run_computes_nothing(
    compared: Path, kept_bake: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path: path.stat().st_mtime_ns for path in (compared / "cache").iterdir()}
    document = (compared / "compare.json").read_text()
    monkeypatch.setattr("kiln_workers.compare.run.solve", lambda *_: pytest.fail("it was solved again"))
    assert main(arguments(kept_bake, compared)) == 0
    assert {path: path.stat().st_mtime_ns for path in (compared / "cache").iterdir()} == before
    assert (compared / "compare.json").read_text() == document
    assert json.loads(capsys.readouterr().out) == json.loads(document)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--solvers", "cnn,magic"], "'magic' is not a solver. Choose some of coherent, cnn"),
        (["--lobes", "8,900"], "--lobes: '8,900' is refused"),
        (["--resolution-image-size", "20"], "multiple of 16"),
        (["--cameras", "nowhere.json"], "nowhere.json"),
        (["--env", "sky.exr", "--store", "/nowhere.zarr"], "there is no light-field store"),
    ],
)
def test_wrong_options_are_sentences(
    kept_bake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main(["compare", str(kept_bake), "--out", str(tmp_path), *arguments]) == 3
    assert sentence in capsys.readouterr().err


def test_what_is_missing_is_said(kept_bake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told(*subject: str) -> str:
        assert main(["compare", *subject, "--out", str(tmp_path / "out"), "--json"]) == 3
        return str(json.loads(capsys.readouterr().out)["detail"])

    store = kept_bake / ".lightkiln" / "store" / ("0" * 32 + ".zarr")
    assert "no such folder" in told(str(tmp_path / "nowhere"))
    moved = tmp_path / "moved.zarr"
    shutil.copytree(store, moved)
    assert "the scene of this store is not known" in told(str(moved))
    alone = tmp_path / "package"
    shutil.copytree(kept_bake, alone, ignore=shutil.ignore_patterns(".lightkiln"))
    assert "store was not kept" in told(str(alone))
    with (alone / "scene.glb").open("ab") as file:
        file.write(b"    ")
    assert "was changed since the bake" in told(str(alone), "--store", str(store))
    (alone / "scene.glb").unlink()
    assert "the scene is missing" in told(str(alone), "--store", str(store))


def test_a_package_of_an_older_version_is_taken(kept_bake: Path, tmp_path: Path) -> None:
    """A setting that is new here changes no hash of what was baked without it."""
    bake = tmp_path / "bake"
    shutil.copytree(kept_bake, bake)
    manifest = json.loads((bake / "manifest.json").read_text())
    del manifest["settings"]["render"]["max_depth"]
    (bake / "manifest.json").write_text(json.dumps(manifest))
    assert open_subject(str(bake), None, None, None).manifest.scene_hash == manifest["scene_hash"]
    (bake / "manifest.json").write_text(json.dumps(manifest | {"scene_hash": "b" * 64}))
    with pytest.raises(InputError, match="rendered from another scene"):
        open_subject(str(bake), None, None, None)


def test_a_store_without_valid_texels_is_refused(
    kept_bake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bake = tmp_path / "bake"
    shutil.copytree(kept_bake, bake)
    subject = open_subject(str(bake), None, None, None)
    arrays = subject.store.read_texel_map()
    subject.store.write_texel_map(arrays | {"state": 2 * (arrays["state"] > 0).astype(np.uint8)})
    assert main(["compare", str(bake), "--out", str(tmp_path / "out")]) == 3
    assert "no texel of the light map is valid" in capsys.readouterr().err
    subject.store.write_texel_map(arrays | {"state": np.zeros_like(arrays["state"])})
    assert main(["compare", str(bake), "--out", str(tmp_path / "out")]) == 3
    assert "not that of the package's scene" in capsys.readouterr().err
