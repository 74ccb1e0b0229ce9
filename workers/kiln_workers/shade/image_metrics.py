"""How different two pictures look."""

from typing import Any

import flip_evaluator
import numpy as np

from kiln_workers.scene.model import Float32


def flip(reference: Float32, test: Float32) -> float:
    """Mean HDR-FLIP (Andersson et al. 2021) of two pictures [H, W, 3], linear Rec.709; 0 is the same, 1 the largest.

    The evaluator takes its exposures from the reference and ends the process where that is black. So both pictures are
    scaled until the reference's peak is 1, which leaves FLIP as it is, and a black reference has one fixed exposure.
    """
    peak = float(reference.max())
    scale = 1.0 / peak if peak > 0.0 else 1.0
    exposures: dict[str, Any] = {} if peak > 0.0 else {"startExposure": 0.0, "stopExposure": 0.0}
    pictures = (np.ascontiguousarray(scale * picture, np.float32) for picture in (reference, test))
    _, mean, _ = flip_evaluator.evaluate(*pictures, "HDR", inputsRGB=False, applyMagma=False, parameters=exposures)
    return float(mean)
