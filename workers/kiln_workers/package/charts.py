"""The report's drawings as inline SVG and data URIs; everything here is made of numbers, never of a user's words."""

import base64
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from kiln_schemas.tasks import CurvePoint
from kiln_workers.package import png
from kiln_workers.package.colour import viridis

UInt8 = npt.NDArray[np.uint8]

CURVE_POINTS: Final = 240
_WIDTH, _HEIGHT = 640, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 66, 30, 12, 34


def data_uri(pixels: UInt8) -> str:
    """A picture [H, W, 1..4] as a PNG data URI."""
    return "data:image/png;base64," + base64.b64encode(png.encode(pixels)).decode("ascii")


def colour_bar_uri() -> str:
    """Viridis from left to right, one row of 256 pixels."""
    return data_uri(viridis(np.linspace(0.0, 1.0, 256))[None])


def short(value: float) -> str:
    """A number in three significant digits, without an exponent where that stays readable."""
    if value == 0.0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        digits = max(0, 2 - math.floor(math.log10(abs(value))))
        return f"{value:,.{digits}f}"
    mantissa, exponent = f"{value:.2e}".split("e")
    superscript = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa}·10{superscript}"


def loss_curve(points: Sequence[CurvePoint]) -> Markup:
    """The training loss over steps on a logarithmic axis; long curves are averaged into CURVE_POINTS bins."""
    steps, losses = _binned(points)
    low, high = _decades(losses)
    last = max(steps)

    def x(step: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * step / last

    def y(loss: float) -> float:
        share = (math.log10(loss) - low) / (high - low)
        return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * share

    parts = [f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="training loss over steps">']
    # Draw a grid line for each decade, and fainter ones at 2 and 5 where there are few decades.
    for exponent in range(math.floor(low), math.ceil(high) + 1):
        for factor in (1, 2, 5) if high - low < 2.5 else (1,):
            tick = math.log10(factor) + exponent
            if low - 1e-9 <= tick <= high + 1e-9:
                at = y(10.0**tick)
                parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
                parts.append(f'<text x="{_LEFT - 8}" y="{at + 4:.1f}" text-anchor="end">{10.0**tick:g}</text>')
    for tick in _round_ticks(last):
        parts.append(f'<text x="{x(tick):.1f}" y="{_HEIGHT - 12}" text-anchor="middle">{tick:,.0f}</text>')
    line = " ".join(f"{x(step):.1f},{y(loss):.1f}" for step, loss in zip(steps, losses, strict=True))
    parts.append(f'<polyline class="line" points="{line}"/>')
    parts.append(f'<circle class="dot" cx="{x(steps[-1]):.1f}" cy="{y(losses[-1]):.1f}" r="4"/></svg>')
    return Markup("".join(parts))


def heat_map(errors: npt.NDArray[np.float32]) -> tuple[UInt8, float, float]:
    """Errors [H, W] on a logarithmic viridis scale as RGBA, transparent where NaN, and the scale's two ends.

    The ends are the 2nd and 98th percentile, so that one outlier does not take all the contrast.
    """
    positive = errors[np.isfinite(errors) & (errors > 0.0)]
    low, high = (float(q) for q in np.quantile(positive, (0.02, 0.98))) if positive.size else (1e-6, 1e-5)
    high = max(high, low * 1.1)
    share = (np.log(np.maximum(np.nan_to_num(errors, nan=low), 1e-30)) - math.log(low)) / math.log(high / low)
    alpha = np.where(np.isfinite(errors), 255, 0).astype(np.uint8)
    return np.concatenate([viridis(share), alpha[..., None]], axis=-1), low, high


def _binned(points: Sequence[CurvePoint]) -> tuple[list[float], list[float]]:
    """Steps and positive losses, averaged in bins of equal numbers of points."""
    usable = [(point.step, point.loss) for point in points if point.loss > 0.0] or [(1, 1e-12)]
    bins = np.array_split(np.array(usable, np.float64), min(CURVE_POINTS, len(usable)))
    means = [part.mean(axis=0) for part in bins]
    return [max(float(m[0]), 1e-9) for m in means], [float(m[1]) for m in means]


def _decades(losses: Sequence[float]) -> tuple[float, float]:
    """The range of log10 loss with a margin, at least half a decade."""
    low, high = math.log10(min(losses)), math.log10(max(losses))
    margin = 0.06 * (high - low) + 0.02
    middle, half = 0.5 * (low + high), max(0.25, 0.5 * (high - low) + margin)
    return middle - half, middle + half


def _round_ticks(last: float) -> list[float]:
    """0 and up to five round steps."""
    raw = last / 5.0
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= raw)
    return [step * i for i in range(int(last / step + 1e-9) + 1)]
