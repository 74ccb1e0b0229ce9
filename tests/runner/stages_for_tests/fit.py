"""A fit that does what the payload's `store_url` says."""

import errno
import os
import signal
import time

from kiln_schemas.errors import InputError
from kiln_schemas.tasks import FitMetrics, FitPayload, FitResult
from kiln_workers.runner.context import Context


def run(payload: FitPayload, context: Context) -> FitResult:
    began = time.perf_counter()
    instruction, _, argument = payload.store_url.partition(":")
    context.cache["tasks"] = context.cache.get("tasks", 0) + 1
    context.progress(1, 4, "steps", instruction, loss=0.5)
    weights = str(os.getpid()).encode()
    match instruction:
        case "print":
            print("stray words on standard output")
            os.write(1, b"stray bytes on descriptor 1\n")
            context.log("a line for the log")
            time.sleep(0.3)
        case "segfault":
            context.log("last words")
            os.kill(os.getpid(), signal.SIGSEGV)
        case "exhaust":
            os.kill(os.getpid(), signal.SIGKILL)
        case "refuse":
            raise InputError("there are no faces", where="scene.glb", remedy="Add some.")
        case "defect":
            raise ValueError("a secret detail")
        case "disk-full":
            raise OSError(errno.ENOSPC, "No space left on device", "/scratch/file")
        case "hang":
            time.sleep(60)
        case "until-canceled":
            while True:
                context.progress(2, 4, "steps")
                time.sleep(0.02)
        case "scratch":
            (context.scratch / "left").write_text("over")
            weights = str(sorted(p.name for p in context.scratch.iterdir())).encode()
        case "checkpoint":
            context.checkpoint(b"half way")
            raise MemoryError
        case "resume":
            weights = context.last_checkpoint() or b""
        case "blob":
            weights = context.blob(argument) + context.blob_path(argument).read_bytes()
        case "environment":
            weights = os.environ["OMP_NUM_THREADS"].encode()
    metrics = FitMetrics(log_mse=0, log_mse_zero=1, log_mse_rel=0, texels=1, signal=True)
    return FitResult(
        function=payload.function,
        weights=context.put_blob(weights),
        exposure=1,
        metrics=metrics,
        curve=(),
        steps=context.cache["tasks"],
        seconds=time.perf_counter() - began,
    )
