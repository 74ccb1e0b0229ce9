"""A whole bake in one process, by the real stages, without a coordinator."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kiln_schemas.errors import Canceled
from kiln_schemas.settings import BakeSettings, Function, Solver
from kiln_schemas.tasks import (
    Bundle,
    EnvironmentRef,
    FitPayload,
    FitResult,
    PackagePayload,
    PackageResult,
    PreparePayload,
    PrepareResult,
    RefinePayload,
    RefineResult,
    RenderPayload,
    RenderResult,
)
from kiln_service.planner import plan_blocks
from kiln_workers.package.glb import encode_glb
from kiln_workers.scene.examples import write_exr
from kiln_workers.scene.model import Scene
from kiln_workers.stages import fit, package, prepare, refine, render


@dataclass
class MemoryContext:
    """A `runner.context.Context` without a coordinator."""

    scratch: Path
    blobs: dict[str, bytes] = field(default_factory=dict)
    cache: dict[str, Any] = field(default_factory=dict)
    memory_bytes: int = 1 << 30
    threads: int = 2
    canceled: bool = False
    messages: list[str] = field(default_factory=list)

    def blob(self, sha256: str) -> bytes:
        return self.blobs[sha256]

    def blob_path(self, sha256: str) -> Path:
        path = self.scratch / sha256
        path.write_bytes(self.blobs[sha256])
        return path

    def put_blob(self, data: bytes | Path) -> str:
        content = data if isinstance(data, bytes) else data.read_bytes()
        sha256 = hashlib.sha256(content).hexdigest()
        self.blobs[sha256] = content
        return sha256

    def progress(self, done: float, total: float, unit: str, message: str = "", loss: float | None = None) -> None:
        assert 0 <= done <= total
        if self.canceled:
            raise Canceled("the task is no longer wanted")

    def checkpoint(self, data: bytes) -> None:
        self.put_blob(data)

    def last_checkpoint(self) -> bytes | None:
        return None

    def log(self, text: str) -> None:
        self.messages.append(text)


@dataclass(frozen=True)
class Baked:
    """Everything that one bake handed on."""

    context: MemoryContext
    prepare_payload: PreparePayload
    prepared: PrepareResult
    renders: tuple[RenderResult, ...]
    fits: tuple[FitResult, ...]
    refine_payloads: tuple[RefinePayload, ...]
    refines: tuple[RefineResult, ...]
    packaged: PackageResult

    def artifact(self, name: str) -> bytes:
        (found,) = (a for a in self.packaged.artifacts if a.name == name)
        return self.context.blobs[found.sha256]

    def render_payload(self, index: int) -> RenderPayload:
        return RenderPayload(
            scene=self.prepared.scene,
            texel_map=self.prepared.texel_map,
            between=self.prepared.between,
            fine=self.prepared.fine,
            tile=self.prepared.tiles[index],
            settings=self.prepare_payload.settings,
            store_url=self.prepare_payload.store_url,
        )

    def download(self, folder: Path) -> Path:
        """The package in a folder, as a client has it."""
        for artifact in self.packaged.artifacts:
            (folder / artifact.name).parent.mkdir(parents=True, exist_ok=True)
            (folder / artifact.name).write_bytes(self.context.blobs[artifact.sha256])
        return folder


def bake(folder: Path, scene: Scene, settings: BakeSettings, **asked: Any) -> Baked:
    """Bake a scene, the store being `folder / "store.zarr"`; `asked` are gates and cameras of the job."""
    files, environment = {"room.glb": encode_glb(scene)}, None
    if scene.environment is not None:
        folder.mkdir(parents=True, exist_ok=True)
        write_exr(folder / "sky.exr", scene.environment.pixels)
        files["sky.exr"] = (folder / "sky.exr").read_bytes()
        environment = EnvironmentRef(file="sky.exr")
    return bake_files(folder, files, settings, environment, **asked)


def bake_files(
    folder: Path,
    files: Mapping[str, bytes],
    settings: BakeSettings,
    environment: EnvironmentRef | None = None,
    **asked: Any,
) -> Baked:
    """The same of a scene's files, by their names; the first is the scene."""
    context = MemoryContext(scratch=folder / "scratch")
    context.scratch.mkdir(parents=True)
    hashes = {name: context.put_blob(data) for name, data in files.items()}
    bundle = Bundle(entry=next(iter(files)), files=hashes, environment=environment)
    common: dict[str, Any] = {"settings": settings, "store_url": (folder / "store.zarr").absolute().as_uri()}
    payload = PreparePayload(bundle=bundle, **common)
    prepared = prepare.run(payload, context)
    maps: dict[str, Any] = {"texel_map": prepared.texel_map, **common}
    placed: dict[str, Any] = {"between": prepared.between, **maps}
    renders = tuple(
        render.run(RenderPayload(scene=prepared.scene, fine=prepared.fine, tile=tile, **placed), context)
        for tile in prepared.tiles
    )
    functions = [Function.LIGHT_FIELD] + ([Function.VISIBILITY] if prepared.has_environment else [])
    fits = tuple(fit.run(FitPayload(function=f, renders=renders, **maps), context) for f in functions)
    blocks = plan_blocks(prepared, settings) if settings.fit.solver is Solver.COHERENT else []
    refine_payloads = tuple(RefinePayload(block=block, renders=renders, fits=fits, **placed) for block in blocks)
    refines = tuple(refine.run(each, context) for each in refine_payloads)
    packaged = package.run(
        PackagePayload(
            job_id="0" * 32,
            job_name="room",
            bundle=bundle,
            prepare=prepared,
            renders=renders,
            fits=fits,
            refines=refines,
            **asked,
            **common,
        ),
        context,
    )
    return Baked(context, payload, prepared, renders, fits, refine_payloads, refines, packaged)
