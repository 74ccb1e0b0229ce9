"""What a comparison finds, as contracts: `compare.json` is a `Comparison`, `compare.csv` its rows without pictures."""

import csv
import io
from typing import Final

from kiln_schemas.base import Contract

NAME_JSON: Final = "compare.json"
NAME_CSV: Final = "compare.csv"
NAME_HTML: Final = "index.html"


class CurvePoint(Contract):
    """Where a solver stood after some passes over all texels."""

    epoch: int
    log_mse: float
    """Over the probe texels."""
    log_mse_between: float | None
    """Over the probe points between them."""


class Folds(Contract):
    """How far lobes turn between neighbours of flat charts, weighted by their energy."""

    p50_deg: float
    p90_deg: float
    p99_deg: float
    above_15_deg: float
    """Share of the energy that turns by more than 15 degrees."""
    histogram: tuple[float, ...]
    """Share of the energy by angle, in the bins of `Comparison.fold_edges_deg`."""


class ImageScore(Contract):
    """A shaded picture against the path-traced reference of the same camera."""

    camera: str
    alpha: float | None
    """GGX alpha of the pixels that count; None: the whole picture."""
    pixels: int
    psnr: float | None
    """dB; None where the pictures are equal."""
    ssim: float | None
    """Of the whole picture; its windows do not fit a mask."""
    flip: float
    flip_noise: float
    """FLIP that the reference's own noise alone gives."""


class Row(Contract):
    """One solver with one number of lobes on one set of stored light fields."""

    scene: str
    solver: str
    lobes: int
    texels: int
    floats_per_texel: int
    epochs: int
    epochs_to_5_percent: int | None
    """Epochs until the probe's log_mse stays within 5 % of its last value."""
    seconds: float
    """Busy seconds of one core."""
    seconds_per_texel: float
    log_mse: float
    log_mse_rel: float
    log_mse_between: float
    log_mse_between_rel: float
    mse: float
    """Mean squared error of exposure-normalised radiance, without the logarithm."""
    interp_ratio: float
    """log_mse_between / log_mse."""
    folds: Folds | None
    """None where there are no lobes, or no flat chart."""
    curve: tuple[CurvePoint, ...]
    images: tuple[ImageScore, ...] = ()


class Camera(Contract):
    """A camera's reference and its noise."""

    name: str
    width: int
    height: int
    samples: int
    psnr_of_halves: float | None
    flip_of_halves: float
    rms_noise: float
    stored: tuple[ImageScore, ...] = ()
    """Scores of the picture shaded from the stored light field itself: the algorithm's error without any fit's."""


class Convergence(Contract):
    """How the network converges on a light map of another size (figure 6), or from another start (figure 8)."""

    label: str
    resolution: int
    texels: int
    image_size: int
    samples: int
    lobes: int
    epochs: int
    epochs_to_5_percent: int | None
    seconds_per_epoch: float
    log_mse: float
    log_mse_rel: float
    curve: tuple[CurvePoint, ...]


class Comparison(Contract):
    """Everything that a comparison found; rows are in the order asked for."""

    scene: str
    scene_hash: str
    store: str
    complete: bool
    """False where the comparison was interrupted; the same command goes on."""
    resolution: tuple[int, int]
    image_size: int
    samples: int
    exposure: float
    texels: int
    tiles: int
    of_tiles: int
    between_points: int
    between_samples: int
    between_noise: float
    """log_mse of the between targets' own noise: no solver can be expected below it."""
    retraced_log_mse_rel: float
    """Difference between stored light fields and the same traced again; near 0 where one renderer made both."""
    fold_edges_deg: tuple[float, ...]
    rows: tuple[Row, ...]
    cameras: tuple[Camera, ...] = ()
    resolutions: tuple[Convergence, ...] = ()
    """The network on light maps of other sizes (figure 6)."""
    starts: tuple[Convergence, ...] = ()
    """The network from its own start and from another scene's network (figure 8)."""
    notes: tuple[str, ...] = ()
    versions: dict[str, str]


def as_csv(rows: tuple[Row, ...]) -> str:
    """One line a row; images are columns named after camera, alpha and metric."""
    lines = [_flat(row) for row in rows]
    columns = list(dict.fromkeys(name for line in lines for name in line))
    out = io.StringIO()
    writer = csv.DictWriter(out, columns or ["scene"], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return out.getvalue()


def _flat(row: Row) -> dict[str, object]:
    line: dict[str, object] = row.model_dump(mode="json", exclude={"folds", "curve", "images"})
    if row.folds is not None:
        line |= {f"fold_{name}": value for name, value in row.folds.model_dump(exclude={"histogram"}).items()}
    for image in row.images:
        place = image.camera if image.alpha is None else f"{image.camera}.alpha_{image.alpha:g}"
        line |= {f"{place}.{metric}": getattr(image, metric) for metric in ("psnr", "ssim", "flip", "flip_noise")}
    return line
