"""The tile at row 8, column 8 of jobs with 9 samples ends the process, as a bug in a renderer does."""

import logging
import os
import signal

from kiln_schemas.tasks import RenderPayload, RenderResult
from kiln_workers.runner.context import Context
from kiln_workers.stages import render


def run(payload: RenderPayload, context: Context) -> RenderResult:
    if payload.settings.render.samples == 9 and (payload.tile.row, payload.tile.column) == (8, 8):
        logging.getLogger(__name__).warning("about to step on a mine")
        os.kill(os.getpid(), signal.SIGSEGV)
    return render.run(payload, context)
