"""The report: self-contained, safe against hostile names, and showing what it says it shows."""

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from kiln_schemas.camera import Camera
from kiln_schemas.gates import GateResult
from kiln_schemas.manifest import Manifest, ReferenceView
from kiln_schemas.settings import Function
from kiln_schemas.tasks import CurvePoint
from kiln_workers.package import charts, report
from kiln_workers.package.build import build_package
from kiln_workers.package.gates import Judgement, View
from kiln_workers.package.preview import choose_texels
from kiln_workers.scene.texel_map import speck_share


class Page(HTMLParser):
    """Elements and attributes of a page, and whether its tags close in order."""

    VOID = frozenset({"meta", "img", "br", "line", "circle", "polyline", "link", "input"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def built(tmp_path: Path, sample) -> tuple[str, Page]:
    build_package(tmp_path, sample.given)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    return text, Page(text)


def test_it_refers_to_nothing_outside_itself(make_sample, tmp_path: Path) -> None:
    text, page = built(tmp_path, make_sample())
    assert not {tag for tag, _ in page.elements} & {"script", "link", "iframe", "object", "embed", "base", "form"}
    sources = [attributes["src"] for tag, attributes in page.elements if tag == "img"]
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert not re.search(r"https?://|url\(|@import", text)
    assert "default-src 'none'" in text


def test_hostile_names_are_text(make_sample, tmp_path: Path) -> None:
    name = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>{{ 7 * 7 }}"
    text, page = built(tmp_path, make_sample(name=name))
    assert not [tag for tag, _ in page.elements if tag == "script"]
    assert not [1 for _, attributes in page.elements if any(key.startswith("on") for key in attributes)]
    assert "<script" not in text
    assert name in "".join(page.text)


def test_it_shows_pictures_of_three_texels_per_function_and_all_figures(make_sample, tmp_path: Path, read_png) -> None:
    sample = make_sample()
    _, page = built(tmp_path, sample)
    by_label = {attributes["alt"]: attributes["src"] for tag, attributes in page.elements if tag == "img"}
    for label in ("best", "median", "worst"):
        for kind in ("traced", "stored"):
            assert f"{label} texel as {kind}" in by_label
    words = "".join(page.text)
    for function in Function:
        assert charts.short(sample.given.metrics[function].log_mse_rel) in words
    picture = read_png(base64.b64decode(by_label["validity, density and charts of the light map"].partition(",")[2]))
    np.testing.assert_array_equal(picture, sample.given.preview.atlas)
    for item in ("lightfield.ktx2", "scene.glb", "shaders/sg.glsl"):
        assert item in words


def test_without_environment_it_says_why_there_is_no_visibility(make_sample, tmp_path: Path) -> None:
    _, page = built(tmp_path, make_sample(environment=False))
    words = "".join(page.text)
    assert "visibility: the scene has no environment" in " ".join(words.split())
    assert "Environment visibility" not in words


def test_gates_and_what_they_compared_are_shown(make_sample, tmp_path: Path, read_png) -> None:
    random = np.random.default_rng(5)
    picture, reference = (random.integers(0, 256, (9, 16, 3), dtype=np.uint8) for _ in range(2))
    results = (GateResult.of("log_mse_rel", 0.1, 0.2), GateResult.of("flip.front", 0.123, 0.08, noise_floor=0.0456))
    seen = ReferenceView(camera=Camera(position=(0, 1, 3), target=(0, 0, 0), fov_deg=45), white=2.0)
    judged = []

    def judge(folder: Path, manifest: Manifest) -> Judgement:
        judged.append((sorted(path.name for path in folder.iterdir()), manifest))
        return Judgement(results, (View("front", seen, picture, reference),))

    artifacts = build_package(tmp_path, make_sample().given, judge)
    ((files, manifest),) = judged
    assert Manifest.model_validate_json((tmp_path / "manifest.json").read_bytes()).views == {"front": seen}
    assert "lightfield.ktx2" in files and "scene.glb" in files and "manifest.json" not in files
    assert manifest.gates == () and "lightfield.ktx2" in manifest.textures
    assert Manifest.model_validate_json((tmp_path / "manifest.json").read_bytes()).gates == results
    assert {"gates.xml", "gates/front.png", "gates/front_reference.png"} <= {item.name for item in artifacts}
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    words = " ".join(" ".join(page.text).split())
    assert "Quality gates: 1 of 2 missed" in words
    assert "log_mse_rel met 0.100 0.200" in words and "flip.front missed 0.123 0.0800 0.0456" in words
    by_label = {attributes["alt"]: attributes["src"] for tag, attributes in page.elements if tag == "img"}
    for label, name, pixels in (("package", "front", picture), ("reference", "front_reference", reference)):
        shown = base64.b64decode(by_label[f"front: the {label}"].partition(",")[2])
        np.testing.assert_array_equal(read_png(shown), pixels)
        np.testing.assert_array_equal(read_png((tmp_path / "gates" / f"{name}.png").read_bytes()), pixels)


def test_without_gates_the_report_has_none(make_sample, tmp_path: Path) -> None:
    text, _ = built(tmp_path, make_sample())
    assert "Quality gates" not in text


def test_pictures_show_only_what_lies_above_the_horizon(make_sample) -> None:
    texel = make_sample().given.preview.functions[Function.LIGHT_FIELD].best
    original, predicted, difference = report.light_field_pictures(texel, Function.LIGHT_FIELD, 0.7)
    above = original[..., 3] == 255
    assert 0.4 < above.mean() < 0.6
    assert (original[..., 3] == predicted[..., 3]).all()
    assert (original[..., 3] == difference[..., 3]).all()
    # Where the metric sees no difference the map shows viridis' dark end.
    same = report.light_field_pictures(
        type(texel)(0, 0, 0.0, texel.normal, texel.original, texel.original), Function.LIGHT_FIELD, 0.7
    )
    assert (same[2][..., :3] == (0x44, 0x01, 0x54)).all()
    np.testing.assert_array_equal(same[0], same[1])


def test_best_median_and_worst_are_chosen_by_error() -> None:
    errors = np.full((3, 4), np.nan, np.float32)
    errors[0, 1], errors[1, 2], errors[2, 3] = 0.3, 0.1, 0.2
    assert choose_texels(errors) == ((1, 2), (2, 3), (0, 1))


def test_the_heat_map_is_clear_where_there_are_no_lobes() -> None:
    errors = np.geomspace(1e-4, 1e-1, 400).reshape(20, 20).astype(np.float32)
    errors[0, :3] = np.nan
    picture, low, high = charts.heat_map(errors)
    assert (picture[0, :3, 3] == 0).all()
    assert (picture[1:, :, 3] == 255).all()
    assert 1e-4 < low < 2e-4 < 5e-2 < high < 1e-1
    assert picture[-1, -1, :3].tolist() == [0xFD, 0xE7, 0x25]


@pytest.mark.parametrize(
    "losses", [[0.5], [0.1, 0.1, 0.1], [1.0, 1e-6], [0.0, 0.0], list(np.geomspace(1.0, 1e-3, 5000))]
)
def test_loss_curves_of_any_length_stay_inside_the_drawing(losses: list[float]) -> None:
    points = [CurvePoint(step=step, loss=loss) for step, loss in enumerate(losses)]
    drawing = str(charts.loss_curve(points))
    (line,) = re.findall(r'points="([^"]*)"', drawing)
    coordinates = np.array([[float(c) for c in pair.split(",")] for pair in line.split()])
    assert np.isfinite(coordinates).all()
    assert len(coordinates) <= charts.CURVE_POINTS
    assert (coordinates >= 0).all()
    assert (coordinates <= (640, 260)).all()


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (0.012345, "0.0123"), (1234.5, "1,234"), (2.5e-6, "2.50·10⁻⁶"), (0.5, "0.500")]
)
def test_numbers_are_short(value: float, text: str) -> None:
    assert charts.short(value) == text


@pytest.mark.parametrize(("value", "word"), [(0.01, "excellent"), (0.149, "good"), (0.3, "poor"), (0.7, "failed")])
def test_the_verdict_follows_the_relative_error(value: float, word: str) -> None:
    assert report.grade(value)[0] == word


def test_a_light_map_of_specks_is_not_called_good(make_sample, tmp_path: Path) -> None:
    sample = make_sample()
    assert speck_share(sample.texel_map.chart) == 0.0
    covered = sample.texel_map.chart >= 0
    sample.texel_map.chart[covered] = np.arange(int(covered.sum())) // 2  # charts of two texels
    text, page = built(tmp_path, sample)
    assert "light map too coarse" in text and not re.search(r": (excellent|very good|good)</h3>", text)
    assert "texels in charts of four or fewer 100 %" in re.sub(r"\s+", " ", "".join(page.text))


@pytest.mark.parametrize(("specks", "word"), [(0.0, "very good"), (0.5, "very good"), (0.51, "light map too coarse")])
def test_the_grade_of_a_coarse_light_map(specks: float, word: str) -> None:
    assert report.grade(0.03, specks)[0] == word
    assert report.grade(0.4, specks)[0] == "poor"


@pytest.mark.parametrize(
    ("flip", "noise", "word"),
    [
        (0.05, 0.04, "like the reference"),
        (0.05, 0.0, "close to the reference"),
        (0.15, 0.05, "visibly different from the reference"),
        (0.3, 0.05, "plainly different from the reference"),
    ],
)
def test_the_verdict_on_pictures_is_what_noise_does_not_explain(flip: float, noise: float, word: str) -> None:
    camera = Camera(position=(0, 1, 3), target=(0, 0, 0), fov_deg=45)
    seen = ReferenceView(camera=camera, white=1.0, flip=flip, noise_floor=noise)
    better = ReferenceView(camera=camera, white=1.0, flip=flip, noise_floor=flip)
    found = report.verdict({"other": better, "front": seen, "old": ReferenceView(camera=camera, white=1.0)})
    assert found is not None and (found["word"], found["camera"]) == (word, "front")


def test_pictures_that_no_gate_asked_for_are_judged_and_shown(make_sample, tmp_path: Path) -> None:
    picture = np.full((9, 16, 3), 90, np.uint8)
    camera = Camera(position=(0, 1, 3), target=(0, 0, 0), fov_deg=45)
    seen = ReferenceView(camera=camera, white=2.0, flip=0.15, noise_floor=0.05, samples=128, width=16, height=9)
    judgement = Judgement((), (View("first", seen, picture, picture),))
    artifacts = build_package(tmp_path, make_sample().given, lambda folder, manifest: judgement)
    names = {item.name for item in artifacts}
    assert {"gates/first.png", "gates/first_reference.png"} <= names and "gates.xml" not in names
    assert Manifest.model_validate_json((tmp_path / "manifest.json").read_bytes()).views == {"first": seen}
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    words = " ".join(" ".join(page.text).split())
    assert "Pictures: visibly different from the reference 0.150 FLIP" in words
    assert "makes 0.0500 of it (16 × 9 pixels, 128 paths each)" in words
    assert "Quality gates" not in words and "first: the reference, path-traced" in words


def test_without_a_picture_nothing_is_said_of_the_look(make_sample, tmp_path: Path) -> None:
    judgement = Judgement(not_compared="the device <gone>")
    build_package(tmp_path, make_sample().given, lambda folder, manifest: judgement)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert report.verdict({}) is None
    assert "was not judged: the device &lt;gone&gt;." in text
    assert "Pictures: not compared" in text and "fit of the lobes: " in text
