"""A refinement that uploads the names of the heavy libraries that its process has imported."""

import sys

from kiln_schemas.tasks import RefinePayload, RefineResult
from kiln_workers.runner.context import Context


def run(payload: RefinePayload, context: Context) -> RefineResult:
    context.progress(1, 1, "steps", f"block {payload.block.row},{payload.block.column}")
    imported = sorted({"mitsuba", "drjit"} & set(sys.modules))
    lobes = context.put_blob(f"imported: {imported}".encode())
    return RefineResult(block=payload.block, lobes=lobes, texels=1, steps=1, seconds=0.0)
