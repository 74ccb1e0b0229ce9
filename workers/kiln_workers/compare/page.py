"""`index.html` of a comparison: the tables and figures of the light-field paper for this scene, in one file.

No scripts, nothing from outside, legible on a phone and in both colour schemes, as the bake's report is. Pictures are
crops of one place for all solvers, enlarged pixel by pixel, because what tells solvers apart is a few pixels wide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from operator import attrgetter
from typing import Any, Final

import jinja2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter

from kiln_schemas.settings import Function
from kiln_workers.compare.charts import Series, error_curves, histogram
from kiln_workers.compare.pictures import Shot, View
from kiln_workers.compare.result import Comparison, Convergence, Row
from kiln_workers.compare.solve import Solved
from kiln_workers.fit.field import TexelField
from kiln_workers.package import charts, colour
from kiln_workers.package.preview import TexelPreview
from kiln_workers.package.report import light_field_pictures

Float32 = npt.NDArray[np.float32]
UInt8 = npt.NDArray[np.uint8]

CROP: Final = (90, 120)
"""Rows and columns of a crop, in pixels of the picture."""

BEST: Final = ("log_mse_rel", "log_mse_between_rel", "mse", "seconds_per_texel")
"""Metrics whose best is marked. Not interp_ratio: who is equally wrong everywhere has the best of these."""


@dataclass(frozen=True)
class Texel:
    """The texel whose light field is shown."""

    field: TexelField
    number: int


@dataclass(frozen=True)
class PageInput:
    """Everything that the page shows."""

    result: Comparison
    texel: Texel
    solved: Sequence[Solved]
    views: Sequence[View]
    shots: Mapping[tuple[str, int, str], Shot]
    """By solver, lobes and camera."""


def render(given: PageInput) -> bytes:
    """The page as UTF-8 HTML."""
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.lstrip_blocks = True
    environment.filters.update(short=charts.short)
    template = (files("kiln_workers.compare") / "templates" / "index.html.j2").read_text(encoding="utf-8")
    result = given.result
    original, crops = _original(given.texel), [(view, crop_of(view)) for view in given.views]
    html = environment.from_string(template).render(
        result=result,
        best=_best(result.rows),
        original=original,
        place=given.texel.field.place[given.texel.number].tolist(),
        shown=[_shown(given, one, crops) for one in given.solved],
        cameras=[_camera(view, place) for view, place in crops],
        scores=[_scores(result, view) for view in given.views],
        curves=_curves(result.rows),
        folds=[_fold(row, result.fold_edges_deg) for row in result.rows if row.folds is not None],
        resolutions=_convergence(result.resolutions, "error over epochs by size of the light map"),
        starts=_convergence(result.starts, "error over epochs by start of the network"),
    )
    return html.encode("utf-8")


def crop_of(view: View) -> tuple[slice, slice]:
    """The place of CROP size with most detail on glossy surfaces (alpha up to the picture's median)."""
    shown = colour.tone_map(view.reference.picture, view.white).astype(np.float64).mean(axis=-1)
    detail = np.hypot(*np.gradient(shown))
    alphas = [alpha for alpha in view.masks if alpha is not None]
    if alphas:
        limit = float(np.median(alphas))
        detail = detail * np.any([view.masks[alpha] for alpha in alphas if alpha <= limit], axis=0)
    height, width = shown.shape
    rows, columns = min(CROP[0], height), min(CROP[1], width)
    inside = uniform_filter(detail, (rows, columns), mode="constant")
    inside = inside[rows // 2 : height - (rows - 1) // 2, columns // 2 : width - (columns - 1) // 2]
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return slice(int(row), int(row) + rows), slice(int(column), int(column) + columns)


def _best(rows: Sequence[Row]) -> set[tuple[str, int, str]]:
    """(solver, lobes, metric) where no other solver with as many lobes is better; nobody is best of one."""
    out = set()
    for lobes in {row.lobes for row in rows}:
        rivals = [row for row in rows if row.lobes == lobes]
        for metric in BEST if len(rivals) > 1 else ():
            best = min(rivals, key=attrgetter(metric))
            out.add((best.solver, lobes, metric))
    return out


def _shown(given: PageInput, one: Solved, crops: Sequence[tuple[View, tuple[slice, slice]]]) -> dict[str, Any]:
    """A row's crops and light field."""
    _, predicted, difference = _light_field(given.texel, one.shown)
    pictures = []
    for view, place in crops:
        shot = given.shots.get((one.row.solver, one.row.lobes, view.name))
        if shot is not None:
            crop = charts.data_uri(colour.tone_map(shot.picture[place], view.white))
            error = charts.data_uri(colour.viridis(shot.error[place] / 0.5))
            pictures.append({"crop": crop, "flip": error, "score": shot.scores[0]})
    uris = {"predicted": charts.data_uri(predicted), "difference": charts.data_uri(difference)}
    return {"row": one.row, "pictures": pictures, **uris}


def _original(texel: Texel) -> str:
    return charts.data_uri(_light_field(texel, np.zeros((texel.field.image_size,) * 2 + (3,), np.float32))[0])


def _light_field(texel: Texel, predicted: Float32) -> tuple[UInt8, UInt8, UInt8]:
    """Pictures of the original, of `predicted` [R, R, 3] (exposure-normalised) and of their difference."""
    field, number = texel.field, texel.number
    x, y, z = (float(value) for value in field.normals[number])
    row, column = (int(value) for value in field.place[number])
    original = field.images[number].astype(np.float32)
    preview = TexelPreview(row, column, 0.0, (x, y, z), original, predicted / np.float32(field.exposure))
    return light_field_pictures(preview, Function.LIGHT_FIELD, field.exposure)


def _camera(view: View, place: tuple[slice, slice]) -> dict[str, Any]:
    """The reference, whole and cropped, and where in the picture the crop is, in per cent."""
    picture = colour.tone_map(view.reference.picture, view.white)
    height, width = picture.shape[:2]
    return {
        "name": view.name,
        "picture": charts.data_uri(picture),
        "crop": charts.data_uri(picture[place]),
        "left": 100.0 * place[1].start / width,
        "top": 100.0 * place[0].start / height,
        "width": 100.0 * (place[1].stop - place[1].start) / width,
        "height": 100.0 * (place[0].stop - place[0].start) / height,
    }


def _scores(result: Comparison, view: View) -> dict[str, Any]:
    """One camera's table: a line a row, a column an alpha; the stored light field comes first."""
    alphas = list(view.masks)
    lines = []
    described = next(camera for camera in result.cameras if camera.name == view.name)
    if described.stored:
        lines.append({"solver": "stored light field", "lobes": "", "scores": _by_alpha(described.stored, view, alphas)})
    for row in result.rows:
        if row.images:
            scores = _by_alpha(row.images, view, alphas)
            lines.append({"solver": row.solver, "lobes": str(row.lobes), "scores": scores})
    noise = [float(view.noise[mask].mean()) for mask in view.masks.values()]
    return {"camera": described, "alphas": alphas, "lines": lines, "noise": noise}


def _by_alpha(scores: Any, view: View, alphas: Sequence[float | None]) -> list[Any]:
    found = {score.alpha: score for score in scores if score.camera == view.name}
    return [found.get(alpha) for alpha in alphas]


def _curves(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Convergence by number of lobes: at texels and between them."""
    out = []
    for lobes in dict.fromkeys(row.lobes for row in rows):
        mine = [row for row in rows if row.lobes == lobes]
        if not any(len(row.curve) > 1 for row in mine):
            continue
        at, between = [], []
        for number, row in enumerate(mine):
            epochs = [point.epoch for point in row.curve]
            at.append(Series(row.solver, epochs, [point.log_mse for point in row.curve], number))
            inter = [(point.epoch, point.log_mse_between) for point in row.curve if point.log_mse_between is not None]
            between.append(Series(row.solver, [x for x, _ in inter], [y for _, y in inter], number))
        out.append(
            {
                "lobes": lobes,
                "at": error_curves(at, f"log_mse over epochs, {lobes} lobes"),
                "between": error_curves(between, f"log_mse_between over epochs, {lobes} lobes"),
                "legend": [{"label": one.label, "style": one.style} for one in at],
            }
        )
    return out


def _fold(row: Row, edges: Sequence[float]) -> dict[str, Any]:
    assert row.folds is not None
    label = f"energy by angle of turning, {row.solver}, {row.lobes} lobes"
    return {"row": row, "chart": histogram(row.folds.histogram, edges, label)}


def _convergence(curves: Sequence[Convergence], label: str) -> dict[str, Any] | None:
    if not curves:
        return None
    series = [
        Series(one.label, [p.epoch for p in one.curve], [p.log_mse for p in one.curve], number)
        for number, one in enumerate(curves)
    ]
    legend = [{"label": one.label, "style": one.style} for one in series]
    return {"chart": error_curves(series, label), "legend": legend, "rows": curves}
