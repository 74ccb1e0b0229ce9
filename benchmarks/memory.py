"""How much memory the prepare and package tasks take by the size of the light map: prints a table and writes JSON.

    python benchmarks/memory.py [--sizes 1024 2048 4096] [--folder DIR] [--json FILE]

The scene is the bundled courtyard, or any file (`--scene`). Each task runs in a process of its own, as in a worker;
files in a folder stand for the coordinator's blobs. `prepare` is the real task. What the tasks between would leave
behind is made up: light fields of 16 x 16 pixels in the real store, and refined lobes of every texel. `package` is the
real task on these. The visibility is left out above 256 texels a side, as its network takes hours there (`--visibility`
has it).

Three peaks are given: of all memory that is mapped in (VmHWM, which counts pages of files that the system may drop at
any time), of the anonymous part alone (RssAnon, seen every 10 ms), and what the task has on its disk.
"""

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from kiln_schemas.settings import Function, make_settings
from kiln_schemas.tasks import (
    Bundle,
    EnvironmentRef,
    FitMetrics,
    FitResult,
    PackagePayload,
    PreparePayload,
    PrepareResult,
    RefineResult,
    RenderResult,
)

IMAGE_SIZE: Final = 16
MIB: Final = 1 << 20
EVERY_S: Final = 0.01
INVALID_EVERY: Final = 101
"""Of so many texels of a tile, one counts as found inside something by the renderer."""


@dataclass
class FolderContext:
    """A `runner.context.Context` whose blobs are files."""

    folder: Path
    threads: int = 2
    memory_bytes: int = 1 << 30
    canceled: bool = False
    cache: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        (self.folder / "blobs").mkdir(parents=True, exist_ok=True)
        self.scratch = Path(tempfile.mkdtemp(prefix="scratch-", dir=self.folder))

    def blob(self, sha256: str) -> bytes:
        return (self.folder / "blobs" / sha256).read_bytes()

    def blob_path(self, sha256: str) -> Path:
        path = self.scratch / f"blob-{sha256}"
        path.unlink(missing_ok=True)
        path.hardlink_to(self.folder / "blobs" / sha256)
        return path

    def put_blob(self, data: bytes | Path) -> str:
        if isinstance(data, bytes):
            sha256 = hashlib.sha256(data).hexdigest()
            (self.folder / "blobs" / sha256).write_bytes(data)
            return sha256
        with data.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        target = self.folder / "blobs" / sha256
        if not target.exists():
            target.hardlink_to(data)
        return sha256

    def progress(self, done: float, total: float, unit: str, message: str = "", loss: float | None = None) -> None:
        print(f"  {message}", file=sys.stderr)

    def checkpoint(self, data: bytes) -> None:
        self.put_blob(data)

    def last_checkpoint(self) -> bytes | None:
        return None

    def log(self, text: str) -> None:
        print(f"  {text}", file=sys.stderr)


def prepare(folder: Path, options: dict[str, Any]) -> dict[str, str]:
    """Run the prepare task; its outputs' hashes."""
    from kiln_workers.stages import prepare as stage

    context = FolderContext(folder)
    scene, sky = Path(options["scene"]), options["environment"]
    files = {scene.name: context.put_blob(scene.read_bytes())}
    if sky:
        files[Path(sky).name] = context.put_blob(Path(sky).read_bytes())
    environment = EnvironmentRef(file=Path(sky).name) if sky else None
    payload = PreparePayload(
        bundle=Bundle(entry=scene.name, files=files, environment=environment),
        settings=make_settings("preview", options["settings"]),
        store_url=(folder / "store.zarr").absolute().as_uri(),
    )
    result = stage.run(payload, context)
    shutil.rmtree(context.scratch)
    (folder / "prepare.json").write_text(json.dumps([payload.model_dump_json(), result.model_dump_json()]))
    between = {f"between {number}": digest for number, digest in enumerate(result.between)}
    return {
        "scene": result.scene,
        "texel map": result.texel_map,
        **between,
        "store": _files_hash(folder / "store.zarr"),
    }


def make_up(folder: Path, options: dict[str, Any]) -> dict[str, str]:
    """Write what the tasks between would: tiles, refined blocks, weights, and the payload of the package task."""
    from kiln_service.planner import plan_blocks
    from kiln_workers.fit.network import Shape
    from kiln_workers.fit.predict import Weights
    from kiln_workers.scene.container import pack
    from kiln_workers.scene.texel_map import unpack_texel_map
    from kiln_workers.stages.tiles import covered_texels, map_coordinates, with_render_verdict
    from kiln_workers.store.light_field import LightFieldStore

    payload, prepared = (
        model.model_validate_json(text)
        for model, text in zip(
            (PreparePayload, PrepareResult), json.loads((folder / "prepare.json").read_text()), strict=True
        )
    )
    context, settings = FolderContext(folder), payload.settings
    texels = unpack_texel_map(context.blob(prepared.texel_map))
    store = LightFieldStore.open(payload.store_url)
    picture = np.random.default_rng(1).lognormal(sigma=0.5, size=(1, IMAGE_SIZE, IMAGE_SIZE, 3))
    renders = []
    for tile in prepared.tiles:
        inside = covered_texels(texels, tile)
        rows, columns = map_coordinates(tile, inside)
        light = 1.0 + 0.5 * np.sin(0.05 * rows) * np.cos(0.03 * columns)
        images = (picture * light[:, None, None, None]).astype(np.float16)
        seen = np.full(images.shape, 0.5, np.float16) if store.functions[1:] else None
        store.write_tile(tile, inside, images, seen, (light[:, None] * [2.0, 1.5, 1.0]).astype(np.float32))
        lost = tuple(inside[INVALID_EVERY // 2 :: INVALID_EVERY].tolist())
        renders.append(RenderResult(tile=tile, paths=1, overflows=0, invalid=len(lost), invalid_texels=lost, seconds=0))
    texels = with_render_verdict(texels, renders)
    refines = []
    for block in plan_blocks(prepared, settings):
        part = texels.state[block.row : block.row + block.size, block.column : block.column + block.size]
        place = np.argwhere(part == 1) + np.array([block.row, block.column])
        blob = pack("lobes", {}, {"lobes": _lobes(place, settings.fit.lobes), "place": place.astype(np.int64)})
        digest = context.put_blob(blob)
        refines.append(RefineResult(block=block, lobes=digest, texels=len(place), steps=1, seconds=0))
    shape = Shape(IMAGE_SIZE, settings.fit.lobes)
    weights = Weights(shape, 0.2, True, np.random.default_rng(2).normal(0, 0.05, shape.size).astype(np.float32))
    functions = list(Function) if options["visibility"] and prepared.has_environment else [Function.LIGHT_FIELD]
    fits = tuple(
        FitResult(
            function=function,
            weights=context.put_blob(weights.to_bytes()),
            exposure=0.2,
            metrics=FitMetrics(log_mse=1, log_mse_zero=2, log_mse_rel=0.5, texels=1, signal=True),
            curve=(),
            steps=1,
            seconds=0,
        )
        for function in functions
    )
    package = PackagePayload(
        job_id="0" * 32,
        job_name="memory",
        bundle=payload.bundle,
        prepare=prepared,
        renders=tuple(renders),
        fits=fits,
        refines=tuple(refines),
        settings=settings,
        store_url=payload.store_url,
    )
    (folder / "package.json").write_text(package.model_dump_json())
    return {}


def package(folder: Path, options: dict[str, Any]) -> dict[str, str]:
    """Run the package task; its files' hashes."""
    from kiln_workers.stages import package as stage

    context = FolderContext(folder)
    payload = PackagePayload.model_validate_json((folder / "package.json").read_bytes())
    result = stage.run(payload, context)
    shutil.rmtree(context.scratch)
    return {artifact.name: artifact.sha256 for artifact in result.artifacts}


def _lobes(place: Any, count: int) -> Any:
    """Lobes [T, N, 7] that drift over the light map, with a little noise."""
    row, column = (place[:, axis, None] for axis in (0, 1))
    number = np.arange(count)
    angle = 2.0 * np.pi * number / count + 0.01 * row
    axis = np.stack([np.cos(angle), 0.5 + 0.3 * np.sin(0.02 * column + number), np.sin(angle)], axis=-1)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    amplitude = 0.3 + 0.2 * np.sin(0.03 * row + 0.02 * column + number)
    noise = ((row * 7919 + column * 104729 + number * 31) % 1009) / 1009
    colour = (amplitude * (1.0 + 0.02 * noise))[..., None] * [1.0, 0.9, 0.8]
    sharpness = np.broadcast_to(4.0 + number, angle.shape)[..., None]
    return np.concatenate([axis, sharpness, colour], axis=-1).astype(np.float32)


def _files_hash(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        if path.name != "zarr.json":
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


TASKS: Final = {"prepare": prepare, "make_up": make_up, "package": package}


def _child(task: str, folder: Path) -> None:
    """Run one task in this process and leave its figures in a file."""
    options = json.loads((folder / "options.json").read_text())
    began = time.perf_counter()
    outputs = TASKS[task](folder, options)
    seconds = time.perf_counter() - began
    peak = next(line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
    figures = {"seconds": seconds, "peak_mib": int(peak) / 1024, "outputs": outputs}
    (folder / f"{task}.figures.json").write_text(json.dumps(figures))


def measured(task: str, folder: Path) -> dict[str, Any]:
    """The figures of one task in a process of its own."""
    process = subprocess.Popen([sys.executable, __file__, "--task", task, "--folder", str(folder)])
    anonymous = disk = 0
    looked = 0.0
    while process.poll() is None:
        anonymous = max(anonymous, _anonymous_kib(process.pid))
        if time.monotonic() - looked > 1.0:
            looked = time.monotonic()
            disk = max(disk, _allocated(folder))
        time.sleep(EVERY_S)
    if process.returncode:
        raise SystemExit(f"{task} failed")
    figures: dict[str, Any] = json.loads((folder / f"{task}.figures.json").read_text())
    return {**figures, "peak_anonymous_mib": anonymous / 1024, "peak_scratch_mib": disk / MIB}


def _anonymous_kib(pid: int) -> int:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("RssAnon")), 0)


def _allocated(folder: Path) -> int:
    """Bytes on the disk of the tasks' own folders."""
    total = 0
    for path in folder.glob("scratch-*/**/*"):
        try:
            state = path.stat()
        except OSError:  # it is gone meanwhile
            continue
        total += 512 * state.st_blocks if state.st_nlink == 1 else 0
    return total


def run(folder: Path, size: int, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Both tasks at one size; `folder` is emptied afterwards."""
    folder.mkdir(parents=True)
    options = {
        "scene": str(arguments.scene),
        "environment": str(arguments.environment) if arguments.environment else "",
        "visibility": arguments.visibility or size <= 256,
        "settings": [
            *(
                "lightmap.irradiance_scale=1",
                f"lightmap.resolution={size}",
                f"lightmap.tile={64 if size > 512 else 16}",
            ),
            *(f"render.image_size={IMAGE_SIZE}", "render.samples=1", "fit.block=64", f"fit.lobes={arguments.lobes}"),
            *arguments.set,
        ],
    }
    (folder / "options.json").write_text(json.dumps(options))
    rows = []
    try:
        for task in TASKS:
            if task == "make_up" and "package" not in arguments.tasks:
                break
            figures = measured(task, folder)
            if task in arguments.tasks:
                rows.append({"size": size, "stage": task, **figures})
                _print_row(rows[-1])
    finally:
        shutil.rmtree(folder)
    return rows


def _print_row(row: dict[str, Any]) -> None:
    print(
        f"{row['size']:6} {row['stage']:8} {row['seconds']:9.1f} {row['peak_mib']:9.0f}"
        f" {row['peak_anonymous_mib']:10.0f} {row['peak_scratch_mib']:9.0f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1024, 2048, 4096])
    parser.add_argument("--tasks", nargs="+", choices=["prepare", "package"], default=["prepare", "package"])
    parser.add_argument("--lobes", type=int, default=16)
    parser.add_argument("--scene", type=Path, help="a scene file instead of the bundled courtyard")
    parser.add_argument("--environment", type=Path)
    parser.add_argument("--visibility", action="store_true")
    parser.add_argument("--set", nargs="*", default=[], help="further settings, key=value")
    parser.add_argument("--folder", type=Path, help="where the tasks' files lie meanwhile")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--task", choices=TASKS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.task:
        _child(arguments.task, arguments.folder)
        return
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        if arguments.scene is None:
            from kiln_workers.scene.examples import write_examples

            write_examples(folder)
            arguments.scene, arguments.environment = folder / "courtyard.glb", folder / "courtyard.exr"
        print(f"{'size':>6} {'stage':8} {'seconds':>9} {'peak MiB':>9} {'anonymous':>10} {'disk MiB':>9}")
        rows = [row for size in arguments.sizes for row in run(folder / str(size), size, arguments)]
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
