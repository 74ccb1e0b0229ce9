"""A worker as the command line starts it, with poisoned stages: URL TOKEN FOLDER."""

import sys
from pathlib import Path

from kiln_schemas.tasks import TaskKind
from kiln_workers.runner.parent import Worker, WorkerOptions

url, token, folder = sys.argv[1:]
options = WorkerOptions(
    url=url,
    token=token,
    name="poisoned",
    kinds=(TaskKind.PREPARE, TaskKind.RENDER),
    memory_bytes=2**30,
    threads=1,
    folder=Path(folder),
    stages="poisoned",
)
Worker(options, lambda event, detail: print(event, detail, flush=True)).run()
