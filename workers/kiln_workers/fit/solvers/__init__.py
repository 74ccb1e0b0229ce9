"""Our solver, the paper's, and those that Currius et al. 2020 compare with, on the same stored
light fields with the same loss.

Each is `solve(field, lobes, on_epoch, *, options)` as `fit.solution` defines it.
"""

from collections.abc import Mapping
from typing import Final

from kiln_workers.fit.solution import Solver
from kiln_workers.fit.solvers.coherent import coherent
from kiln_workers.fit.solvers.descent import adam, adam_aligned, adam_random
from kiln_workers.fit.solvers.encoder import cnn
from kiln_workers.fit.solvers.fixed_lobes import fixed, fixed_12, fixed_log
from kiln_workers.fit.solvers.harmonics import sh
from kiln_workers.fit.solvers.mixture import em, em_aligned
from kiln_workers.fit.solvers.reference import lbfgs

SOLVERS: Final[Mapping[str, Solver]] = {
    "coherent": coherent,
    "cnn": cnn,
    "adam": adam,
    "adam-random": adam_random,
    "adam-aligned": adam_aligned,
    "em": em,
    "em-aligned": em_aligned,
    "fixed": fixed,
    "fixed-12": fixed_12,
    "fixed-log": fixed_log,
    "sh": sh,
    "lbfgs": lbfgs,
}
