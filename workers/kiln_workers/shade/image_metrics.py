"""How different two pictures look."""

import flip_evaluator
import numpy as np

from kiln_workers.scene.model import Float32


def flip(reference: Float32, test: Float32) -> float:
    """Mean HDR-FLIP (Andersson et al. 2021) of two pictures [H, W, 3], linear Rec.709; 0 is the same, 1 the largest."""
    pictures = (np.ascontiguousarray(picture, np.float32) for picture in (reference, test))
    _, mean, _ = flip_evaluator.evaluate(*pictures, "HDR", inputsRGB=False, applyMagma=False)
    return float(mean)
