"""kill -9 of a render worker, of the training worker and of the coordinator during a bake: the same bytes come out."""

from pathlib import Path

from e2e_farm import Farm, digests, settings, threads, wait_until

SLOW_FIT = ("fit.steps=1500", "fit.checkpoint_s=1")
"""Long enough to be killed between two checkpoints."""


def fit_progress(farm: Farm, job: str) -> float:
    """Fraction of the running fit's steps."""
    running = [t["progress"] for t in farm.tasks(job, "fit") if t["state"] == "active" and t["progress"]]
    return max((at["done"] / at["total"] for at in running), default=0.0)


def test_killed_processes_change_no_byte(farm: Farm, room_files: tuple[Path, Path], folder: Path) -> None:
    scene, environment = room_files
    flags = ["--kinds", "prepare,render,fit,package", "--threads", threads()]

    # The undisturbed bake.
    farm.start_worker("steady", *flags)
    calm = farm.submit(scene, environment, *settings(*SLOW_FIT))
    farm.finish(calm)
    farm.processes["steady"].terminate()
    farm.processes["steady"].wait(30)

    # A render worker dies with a tile in its hands, and another takes over.
    job = farm.submit(scene, environment, *settings(*SLOW_FIT))
    farm.start_worker("first", *flags)
    wait_until("a tile is being rendered", lambda: any(t["state"] == "active" for t in farm.tasks(job, "render")))
    farm.kill("first")
    farm.start_worker("second", *flags)

    # The training process dies after a checkpoint; its parent starts another, which goes on from there.
    wait_until("the fit has published checkpoints", lambda: fit_progress(farm, job) > 0.3)
    farm.kill("second", children_only=True)
    log = farm.folder / "second.log"
    wait_until("the fit goes on", lambda: "light_field: going on from a checkpoint" in log.read_text())

    # The coordinator dies while the fit goes on, and comes back.
    wait_until("the fit goes on", lambda: fit_progress(farm, job) > 0.5)
    farm.kill("coordinator")
    farm.start_coordinator()

    farm.finish(job)
    farm.processes["second"].terminate()
    farm.processes["second"].wait(30)
    assert digests(farm.download(job, folder / "disturbed")) == digests(farm.download(calm, folder / "calm"))

    # The crashes were real, and the fan-in happened once.
    attempts = {kind: max(task["attempt"] for task in farm.tasks(job, kind)) for kind in ("render", "fit")}
    assert attempts["render"] >= 2 and attempts["fit"] >= 2, attempts
    assert sorted(task["label"] for task in farm.tasks(job, "fit")) == ["light_field", "visibility"]
    assert len(farm.tasks(job, "package")) == 1
