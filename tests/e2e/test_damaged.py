"""A deleted store, shards and blobs with a wrong byte: found and made again, and the same package comes out."""

import shutil
from pathlib import Path

from e2e_farm import Farm, digests, settings, threads, wait_until

ARRAYS = ("light_field", "irradiance", "visibility")


def flip(path: Path) -> None:
    """One bit of a byte in the middle is wrong."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def delete(folder: Path) -> None:
    """At once, though a worker may be writing into it."""
    away = folder.rename(folder.parent.parent / f"{folder.name}.deleted")
    shutil.rmtree(away, ignore_errors=True)


def done(farm: Farm, job: str, kind: str) -> int:
    return sum(task["state"] == "completed" for task in farm.tasks(job, kind))


def test_what_disks_damage_and_people_delete_changes_no_byte(
    farm: Farm, room_files: tuple[Path, Path], baked: Path, folder: Path
) -> None:
    every, tiles = ["--threads", threads()], ["--kinds", "prepare,render", "--threads", threads()]
    store = farm.folder / "data" / "store"

    # The store is deleted while tiles render.
    job = farm.submit(*room_files, *settings())
    farm.start_worker("tiles", *tiles)
    wait_until("a tile is rendered", lambda: done(farm, job, "render"))
    delete(store / f"{job}.zarr")
    total = len(farm.tasks(job, "render"))
    wait_until("the tiles are rendered", lambda: done(farm, job, "render") == total)
    assert max(task["attempt"] for task in farm.tasks(job, "prepare")) == 2
    farm.end("tiles")

    # Nobody works: bytes of two arrays, a whole shard, and all that the prepare task made.
    shards = {
        name: sorted(p for p in (store / f"{job}.zarr" / name / "c").rglob("0") if p.is_file()) for name in ARRAYS
    }
    flip(shards["light_field"][0])
    flip(shards["irradiance"][1])
    shards["visibility"][2].unlink()
    blobs = [path for path in (farm.folder / "data" / "blobs").rglob("*") if path.is_file()]
    prepared = [blob for blob in blobs if blob.read_bytes().startswith(b"KILNARR1")]
    assert len(prepared) >= 2, "the scene and the texel maps"
    for blob in prepared:
        flip(blob)
    farm.start_worker("all", *every)
    farm.finish(job)
    assert digests(farm.download(job, folder / "disturbed")) == digests(baked)
    again = {task["label"] for task in farm.tasks(job, "render") if task["attempt"] > 1}
    assert again, "tiles were rendered again"

    # Deleted afterwards: the next job that would have reused the light fields renders them.
    delete(store / f"{job}.zarr")
    second = farm.submit(*room_files, *settings("fit.lobes=4"))
    farm.finish(second)
    assert farm.get(f"/v1/jobs/{second}")["renders_of"] is None
    farm.end("all")
