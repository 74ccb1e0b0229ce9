"""The comparison's drawings as inline SVG: error over epochs for several solvers, and histograms of folds.

Labels are solvers' names, numbers and file names; all are escaped. Colours are style classes of the page, so that both
schemes have their own; lines beyond the last colour repeat them dashed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from markupsafe import Markup, escape

COLOURS: Final = 8
_WIDTH, _HEIGHT = 640, 330
_LEFT, _RIGHT, _TOP, _BOTTOM = 74, 16, 12, 44
_LEAST: Final = 1e-12


@dataclass(frozen=True)
class Series:
    """One line."""

    label: str
    epochs: Sequence[float]
    errors: Sequence[float]
    number: int
    """Chooses colour and dashes."""

    @property
    def style(self) -> str:
        """Classes of the line."""
        return f"c{self.number % COLOURS}{' dashed' if self.number >= COLOURS else ''}"


@dataclass(frozen=True)
class _Axis:
    """A logarithmic axis from `low` to `high` (decades) onto pixels."""

    low: float
    high: float
    first: float
    last: float

    @classmethod
    def around(cls, values: Sequence[float], first: float, last: float) -> "_Axis":
        logs = [math.log10(max(value, _LEAST)) for value in values]
        low, high = min(logs), max(logs)
        margin = max(0.03 * (high - low), 0.02)
        return cls(low - margin, high + margin, first, last)

    def __call__(self, value: float) -> float:
        share = (math.log10(max(value, _LEAST)) - self.low) / (self.high - self.low)
        return self.first + (self.last - self.first) * share

    def ticks(self) -> list[float]:
        """Decades; also 2 and 5 times them where there are few."""
        factors = (1, 2, 5) if self.high - self.low < 2.5 else (1,)
        values = [f * 10.0**e for e in range(math.floor(self.low), math.ceil(self.high) + 1) for f in factors]
        return [value for value in values if self.low <= math.log10(value) <= self.high]


def error_curves(series: Sequence[Series], label: str) -> Markup:
    """Error over epochs, both logarithmic, with a dot at the end of each line."""
    across = _Axis.around([max(x, 1.0) for s in series for x in s.epochs], _LEFT, _WIDTH - _RIGHT)
    down = _Axis.around([y for s in series for y in s.errors], _HEIGHT - _BOTTOM, _TOP)
    parts = [f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(label)}">']
    for tick in down.ticks():
        y = down(tick)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 5:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in across.ticks():
        parts.append(f'<text x="{across(tick):.1f}" y="{_HEIGHT - 22}" text-anchor="middle">{tick:,.0f}</text>')
    middle = 0.5 * (_LEFT + _WIDTH - _RIGHT)
    parts.append(f'<text class="axis" x="{middle:.0f}" y="{_HEIGHT - 4}" text-anchor="middle">epochs</text>')
    for one in series:
        at = [f"{across(max(x, 1.0)):.1f},{down(y):.1f}" for x, y in zip(one.epochs, one.errors, strict=True)]
        parts.append(f'<polyline class="line {one.style}" points="{" ".join(at)}"><title>')
        parts.append(f"{escape(one.label)}</title></polyline>")
        end = across(max(one.epochs[-1], 1.0)), down(one.errors[-1])
        parts.append(f'<circle class="dot {one.style}" cx="{end[0]:.1f}" cy="{end[1]:.1f}" r="4"/>')
    parts.append("</svg>")
    return Markup("".join(parts))


def histogram(shares: Sequence[float], edges: Sequence[float], label: str) -> Markup:
    """Bars of shares between `edges` in degrees, from 0 to 1; bins of equal width, because the edges grow."""
    width, height, foot = 230.0, 96.0, 18.0
    step = width / len(shares)
    parts = [f'<svg class="chart" viewBox="0 0 {width:.0f} {height + foot:.0f}" role="img"']
    parts.append(f' aria-label="{escape(label)}">')
    for number, share in enumerate(shares):
        tall = height * share
        fold = " fold" if edges[number] >= 15.0 else ""
        parts.append(f'<rect class="bar{fold}" x="{number * step + 1:.1f}" y="{height - tall:.1f}"')
        parts.append(f' width="{step - 2:.1f}" height="{tall:.1f}"><title>{edges[number]:g} to {edges[number + 1]:g}°:')
        parts.append(f" {100.0 * share:.1f} %</title></rect>")
        parts.append(f'<text x="{number * step:.1f}" y="{height + foot - 4:.0f}" text-anchor="middle" class="small">')
        parts.append(f"{edges[number]:g}</text>" if number else "</text>")
    parts.append(f'<line class="grid" x1="0" x2="{width:.0f}" y1="{height:.0f}" y2="{height:.0f}"/></svg>')
    return Markup("".join(parts))
