"""As it is."""

from kiln_workers.stages.prepare import run

__all__ = ["run"]
