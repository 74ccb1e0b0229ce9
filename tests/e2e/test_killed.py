"""kill -9 of a render worker, of the training worker and of the coordinator during a bake: the same bytes come out."""

from pathlib import Path

from e2e_farm import Farm, digests, lightkiln, settings, threads, wait_until


def blobs(farm: Farm) -> int:
    """How many blobs the coordinator holds; during a fit they grow by its checkpoints."""
    return sum(1 for path in (farm.folder / "data" / "blobs").rglob("*") if path.is_file())


def is_active(farm: Farm, job: str, kind: str) -> bool:
    return any(task["state"] == "active" for task in farm.tasks(job, kind))


def test_killed_processes_change_no_byte(farm: Farm, room_files: tuple[Path, Path], folder: Path) -> None:
    """Against the undisturbed bake of one command, which makes a checkpoint a minute and so none at all."""
    scene, environment = room_files
    network = ["fit.solver=cnn", "fit.steps=400", "fit.visibility_steps=400"]
    flags = ["--preset", "draft", *settings(*network), "--out", folder / "undisturbed"]
    done = lightkiln("bake", scene, "--env", environment, *flags)
    assert done.returncode == 0, done.stderr

    flags = ["--kinds", "prepare,render,fit,refine,package", "--threads", threads()]
    job = farm.submit(*room_files, *settings(*network, "fit.checkpoint_s=1"))

    # A render worker dies with a tile in its hands, and another takes over.
    farm.start_worker("first", *flags)
    wait_until("a tile is being rendered", lambda: is_active(farm, job, "render"))
    farm.kill("first")
    farm.start_worker("second", *flags)

    # The training process dies after a checkpoint; its parent starts another, which goes on from there.
    wait_until("a fit is running", lambda: is_active(farm, job, "fit"))
    before = blobs(farm)
    # The second one is uploaded after the coordinator has been told of the first.
    wait_until("the fit has published a checkpoint", lambda: blobs(farm) > before + 1)
    farm.kill("second", children_only=True)
    log = farm.folder / "second.log"
    wait_until("the fit goes on", lambda: ": going on from a checkpoint" in log.read_text())

    # The coordinator dies while the fit goes on, and comes back.
    farm.kill("coordinator")
    farm.start_coordinator()

    farm.finish(job)
    farm.end("second")
    assert digests(farm.download(job, folder / "disturbed")) == digests(folder / "undisturbed")

    # The crashes were real, and the fan-in happened once.
    attempts = {kind: max(task["attempt"] for task in farm.tasks(job, kind)) for kind in ("render", "fit")}
    assert attempts["render"] >= 2 and attempts["fit"] >= 2, attempts
    assert sorted(task["label"] for task in farm.tasks(job, "fit")) == ["light_field", "visibility"]
    assert len(farm.tasks(job, "package")) == 1
