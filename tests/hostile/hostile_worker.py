"""`python hostile_worker.py URL TOKEN FOLDER`: a real worker for prepare tasks whose stages are watched."""

import sys
from pathlib import Path

from kiln_schemas.tasks import TaskKind
from kiln_workers.runner.parent import Worker, WorkerOptions


def main() -> None:
    url, token, folder = sys.argv[1:]
    options = WorkerOptions(
        url=url,
        token=token,
        name="watched",
        kinds=(TaskKind.PREPARE,),
        memory_bytes=1 << 30,
        threads=1,
        folder=Path(folder),
        stages="hostile_stages",
    )
    Worker(options, lambda event, details: print(event, details, flush=True)).run()


if __name__ == "__main__":
    main()
