"""The loss over the steps of a fit, as few points."""

from dataclasses import dataclass, field
from typing import Final

from kiln_schemas.tasks import CurvePoint

POINTS: Final = 200


@dataclass
class Curve:
    """About POINTS means over equally many steps in a row."""

    points: list[CurvePoint] = field(default_factory=list)
    pending: list[float] = field(default_factory=list)
    """Losses since the last point."""

    @property
    def last(self) -> float:
        """The latest point's loss, or before the first point the latest one."""
        return self.points[-1].loss if self.points else self.pending[-1]

    def add(self, step: int, loss: float, steps: int) -> None:
        """The loss of step number `step` of `steps`, counted from 1."""
        self.pending.append(loss)
        if step % max(1, steps // POINTS) == 0 or step == steps:
            self.points.append(CurvePoint(step=step, loss=sum(self.pending) / len(self.pending)))
            self.pending.clear()
