"""`report.html`: one file that says what was baked, how good it is and how long it took, with pictures.

It has no scripts and refers to nothing outside itself (its content security policy says so), is legible on a phone, and
follows the reader's light or dark scheme. Names in it come from users and are escaped by Jinja2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any, Final

import jinja2
import numpy as np
import numpy.typing as npt

from kiln_schemas.manifest import Manifest, ReferenceView
from kiln_schemas.settings import Function
from kiln_schemas.tasks import Artifact, FitMetrics, FitResult
from kiln_workers.package import charts, colour
from kiln_workers.package.gates import Judgement
from kiln_workers.package.preview import FunctionPreview, PackagePreview, TexelPreview
from kiln_workers.scene.picture import thinned
from kiln_workers.scene.texel_map import COARSE
from kiln_workers.sphere import octahedral

Float32 = npt.NDArray[np.float32]
UInt8 = npt.NDArray[np.uint8]

_TITLES: Final = {Function.LIGHT_FIELD: "Light field", Function.VISIBILITY: "Environment visibility"}
_MEANINGS: Final = {
    Function.LIGHT_FIELD: "Radiance that arrives at the texel from the scene's surfaces, over the whole sphere.",
    Function.VISIBILITY: "Share of the blurred environment that the texel's reflection lobe sees: 1 is unoccluded.",
}
_GRADES: Final = (
    (0.02, "excellent", "good"),
    (0.05, "very good", "good"),
    (0.15, "good", "good"),
    (0.30, "rough", "fair"),
    (0.50, "poor", "poor"),
)
"""Upper bounds of log_mse_rel, the word for it and its style; from 0.5 on a bake fails (kiln_workers.fit)."""


LARGEST_MAP: Final = 1024
"""Pixels along a side of the irradiance map that the report shows, at most."""

_PICTURE_GRADES: Final = (
    (0.02, "like the reference", "good"),
    (0.06, "close to the reference", "good"),
    (0.12, "visibly different from the reference", "fair"),
)
"""Upper bounds of FLIP beyond what the reference's noise makes, the word for it and its style."""


@dataclass(frozen=True)
class ReportInput:
    """Everything that the report shows."""

    manifest: Manifest
    fits: Sequence[FitResult]
    preview: PackagePreview
    irradiance: Float32  # [H, W, 3], dilated
    covered: npt.NDArray[np.bool_]  # [H, W]
    judgement: Judgement = field(default_factory=Judgement)


def render(report: ReportInput) -> bytes:
    """The report as UTF-8 HTML."""
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.lstrip_blocks = True
    environment.filters.update(short=charts.short, seconds=_seconds, size=_size)
    template = (files("kiln_workers.package") / "templates" / "report.html.j2").read_text(encoding="utf-8")
    fits = {fit.function: fit for fit in report.fits}
    manifest = report.manifest
    functions = [
        _function_view(
            function, metrics, fits[function], report.preview.functions.get(function), manifest.lightmap["speck_share"]
        )
        for function, metrics in _present(manifest)
    ]
    html = environment.from_string(template).render(
        manifest=manifest,
        settings=_flat(manifest.settings.model_dump(mode="json")),
        functions=functions,
        verdict=verdict(manifest.views),
        not_compared=report.judgement.not_compared,
        views=[
            {
                "camera": v.camera,
                "seen": v.seen,
                "picture": charts.data_uri(v.picture),
                "reference": charts.data_uri(v.reference),
            }
            for v in report.judgement.views
        ],
        stages=_stages(manifest.stage_seconds),
        atlas=charts.data_uri(report.preview.atlas),
        irradiance=charts.data_uri(_irradiance_picture(thinned(report.irradiance), thinned(report.covered))),
        colour_bar=charts.colour_bar_uri(),
        files=sorted(manifest.files, key=_file_order),
    )
    return html.encode("utf-8")


def verdict(views: Mapping[str, ReferenceView]) -> dict[str, Any] | None:
    """What the pictures say of the bake, by the worst of them; None where none was compared."""
    excess = {camera: seen.flip - (seen.noise_floor or 0.0) for camera, seen in views.items() if seen.flip is not None}
    if not excess:
        return None
    camera = max(excess, key=lambda name: excess[name])
    word, style = _word_of(excess[camera], _PICTURE_GRADES, "plainly different from the reference")
    return {"word": word, "style": style, "camera": camera, "seen": views[camera], "of_several": len(excess) > 1}


def grade(log_mse_rel: float, speck_share: float = 0.0) -> tuple[str, str]:
    """A word for a relative error and the style that shows it.

    Lobes may fit each texel well and the bake still be poor: no light map that consists of specks is called good.
    """
    if speck_share > COARSE and log_mse_rel < _GRADES[3][0]:
        return "light map too coarse", "poor"
    return _word_of(log_mse_rel, _GRADES, "failed")


def _word_of(value: float, grades: Sequence[tuple[float, str, str]], beyond: str) -> tuple[str, str]:
    """The word and style of the first bound that the value is under; `beyond`, in the style of poor, of none."""
    return next(((word, style) for bound, word, style in grades if value < bound), (beyond, "poor"))


def light_field_pictures(texel: TexelPreview, function: Function, exposure: float) -> tuple[UInt8, UInt8, UInt8]:
    """Original, prediction and difference [R, R, 4] as octahedral maps, transparent below the texel's horizon.

    Radiance is tone-mapped with one white point for both; visibility is shown as it is. The difference is the metric's,
    |log(1 + T) - log(1 + P)| averaged over channels, from 0 (violet) to 0.25 (yellow).
    """
    directions = octahedral.pixel_directions(texel.original.shape[0])
    above = directions @ np.asarray(texel.normal, np.float64) > 0.0
    alpha = np.where(above, 255, 0).astype(np.uint8)[..., None]
    if function is Function.LIGHT_FIELD:
        white = colour.white_point(texel.original[above])
        pictures = [colour.tone_map(image, white) for image in (texel.original, texel.predicted)]
    else:
        pictures = [colour.quantise(image) for image in (texel.original, texel.predicted)]
    logs = [np.log1p(np.maximum(image, 0.0) * exposure) for image in (texel.original, texel.predicted)]
    difference = np.abs(logs[0] - logs[1]).mean(axis=-1)
    original, predicted, shown = (
        np.concatenate([picture, alpha], axis=-1) for picture in (*pictures, colour.viridis(difference / 0.25))
    )
    return original, predicted, shown


def _present(manifest: Manifest) -> list[tuple[Function, FitMetrics]]:
    pairs = (
        (Function.LIGHT_FIELD, manifest.metrics.light_field),
        (Function.VISIBILITY, manifest.metrics.visibility),
    )
    return [(function, metrics) for function, metrics in pairs if metrics is not None]


def _function_view(
    function: Function, metrics: FitMetrics, fit: FitResult, preview: FunctionPreview | None, specks: float
) -> dict[str, Any]:
    """What the template shows about one function."""
    word, style = grade(metrics.log_mse_rel, specks) if metrics.signal else ("nothing to fit", "fair")
    view: dict[str, Any] = {
        "title": _TITLES[function],
        "meaning": _MEANINGS[function],
        "metrics": metrics,
        "word": word,
        "style": style,
        "explained": 100.0 * (1.0 - metrics.log_mse_rel),
        "fit": fit,
        "final_loss": fit.curve[-1].loss if fit.curve else None,
        "curve": charts.loss_curve(fit.curve) if fit.curve else None,
        "texels": [],
        "heat": None,
    }
    if preview is None:
        return view
    for label, texel in preview.texels():
        pictures = light_field_pictures(texel, function, fit.exposure)
        uris = [charts.data_uri(picture) for picture in pictures]
        view["texels"].append({"label": label, "texel": texel, "uris": uris})
    picture, low, high = charts.heat_map(thinned(preview.errors))
    height, width = preview.errors.shape
    marks = [
        {"letter": label[0].upper(), "x": 100.0 * (t.column + 0.5) / width, "y": 100.0 * (t.row + 0.5) / height}
        for label, t in preview.texels()
    ]
    middle = float(np.sqrt(low * high))
    view["heat"] = {"uri": charts.data_uri(picture), "low": low, "middle": middle, "high": high, "marks": marks}
    return view


def _stages(stage_seconds: Mapping[str, float]) -> list[dict[str, Any]]:
    total = sum(stage_seconds.values()) or 1.0
    return [
        {"name": name, "seconds": seconds, "share": 100.0 * seconds / total, "hue": number % 6}
        for number, (name, seconds) in enumerate(stage_seconds.items())
    ]


def _irradiance_picture(irradiance: Float32, covered: npt.NDArray[np.bool_]) -> UInt8:
    """Irradiance as display colours; gutters show what they were filled with, dimmed. Large maps are thinned out."""
    stride = -(-max(covered.shape) // LARGEST_MAP)
    irradiance, covered = irradiance[::stride, ::stride], covered[::stride, ::stride]
    picture = colour.tone_map(irradiance, colour.white_point(irradiance[covered]))
    alpha = np.where(covered, 255, 96).astype(np.uint8)[..., None]
    return np.concatenate([picture, alpha], axis=-1)


def _flat(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for key, value in tree.items():
        out += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, value)]
    return out


def _file_order(item: Artifact) -> tuple[bool, str]:
    return "/" in item.name, item.name


def _seconds(value: float) -> str:
    if value < 10.0:
        return f"{value:.1f} s"
    if value < 120.0:
        return f"{value:.0f} s"
    minutes, rest = divmod(round(value), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def _size(value: int) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if value >= scale:
            return f"{value / scale:.1f} {unit}"
    return f"{value} B"
