"""WGSL and SPIR-V on a device without a browser: wgpu, whose compiler is naga.

wgpu draws on Vulkan, for which chromium brings a software driver and its loader. Meant to run in a process of its own
(`conftest.native`), with the drivers' threads and libraries.
"""

import ctypes
import functools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shader_probes
from shader_probes import Image

CHROMIUM = Path("/usr/lib/chromium")


@functools.cache
def _device():
    """A device on chromium's software Vulkan."""
    os.environ["VK_ICD_FILENAMES"] = str(CHROMIUM / "vk_swiftshader_icd.json")
    ctypes.CDLL(str(CHROMIUM / "libvulkan.so.1"), ctypes.RTLD_GLOBAL)
    import wgpu

    return wgpu.gpu.request_adapter_sync().request_device_sync()


def check(code: str | bytes) -> None:
    """ValueError with naga's messages where it refuses WGSL (text) or SPIR-V (bytes)."""
    from wgpu import GPUValidationError

    try:
        _device().create_shader_module(code=code)
    except GPUValidationError as error:
        raise ValueError(str(error)) from None


def run(code: str | bytes, inputs: np.ndarray, textures: Mapping[str, Image]) -> np.ndarray:
    """What a probe program writes: float32 [rows, P, 4]."""
    from wgpu import BufferUsage

    device = _device()
    pipeline = device.create_compute_pipeline(
        layout="auto", compute={"module": device.create_shader_module(code=code), "entry_point": "main"}
    )
    given = device.create_buffer_with_data(data=inputs, usage=BufferUsage.STORAGE)
    rows, points = len(shader_probes.ROWS), len(inputs)
    results = device.create_buffer(size=rows * points * 16, usage=BufferUsage.STORAGE | BufferUsage.COPY_SRC)
    views = [_view(image) for image in textures.values()]
    resources = [{"buffer": given}, {"buffer": results}, _sampler(), *views]
    encoder = device.create_command_encoder()
    compute = encoder.begin_compute_pass()
    compute.set_pipeline(pipeline)
    compute.set_bind_group(0, _group(pipeline, 0, dict(enumerate(resources))))
    compute.dispatch_workgroups(points // 64, rows)
    compute.end()
    device.queue.submit([encoder.finish()])
    return np.frombuffer(device.queue.read_buffer(results), np.float32).reshape(rows, points, 4)


@dataclass(frozen=True)
class Drawn:
    """A mesh and its material, as the example programs take them."""

    vertices: np.ndarray  # float32 [V, 22] position, normal, TEXCOORD_0, TEXCOORD_1, COLOR_0, TEXCOORD_2, _3, TANGENT
    indices: np.ndarray  # uint32 [F, 3]
    material: bytes
    maps: tuple[Image | None, ...]  # base colour, metallic and roughness, emission, normal; None where not bound
    wrap: tuple[str, str]  # WebGPU's names
    stages: tuple["Stage", "Stage"]
    veil: bool  # what is behind it is seen through it


@dataclass(frozen=True)
class Stage:
    code: str | bytes
    entry: str


def draw(
    uniforms: Mapping[int, bytes], light: Mapping[int, Image], meshes: Sequence[Drawn], size: tuple[int, int]
) -> np.ndarray:
    """The picture float32 [H, W, 4] that example programs draw; bindings are numbered as in surface.wgsl.

    Veils are drawn after all else, in their order, and laid over it by their alpha, with which they are multiplied.
    """
    picture = np.zeros((*size[::-1], 4), np.float32)
    opaque = [mesh for mesh in meshes if not mesh.veil]
    for veil in (None, *(mesh for mesh in meshes if mesh.veil)):
        # What stands before a veil hides it: all is drawn again, black and opaque, but for the veil.
        layer = _drawn(uniforms, light, opaque, veil, size)
        picture = layer if veil is None else layer + (1.0 - layer[..., 3:]) * picture
    return picture


def _drawn(
    uniforms: Mapping[int, bytes],
    light: Mapping[int, Image],
    opaque: Sequence[Drawn],
    veil: Drawn | None,
    size: tuple[int, int],
) -> np.ndarray:
    """The opaque meshes [H, W, 4], or a veil alone, 0 where they hide it."""
    from wgpu import BufferUsage, TextureUsage

    device, (width, height) = _device(), size
    picture, depth = (
        device.create_texture(
            size=(width, height, 1), format=of, usage=TextureUsage.RENDER_ATTACHMENT | TextureUsage.COPY_SRC
        )
        for of in ("rgba32float", "depth32float")
    )
    encoder = device.create_command_encoder()
    drawing = encoder.begin_render_pass(
        color_attachments=[{"view": picture.create_view(), "load_op": "clear", "store_op": "store"}],
        depth_stencil_attachment={
            "view": depth.create_view(),
            "depth_clear_value": 1.0,
            "depth_load_op": "clear",
            "depth_store_op": "store",
        },
    )

    def buffer(data: bytes | np.ndarray, usage: int) -> Any:
        return device.create_buffer_with_data(data=data, usage=usage)

    shared = {at: {"buffer": buffer(data, BufferUsage.UNIFORM | BufferUsage.STORAGE)} for at, data in uniforms.items()}
    shared |= {at: _view(image) for at, image in light.items()} | {6: _sampler()}
    for mesh in (*opaque, *([veil] if veil else [])):
        pipeline = _pipeline(mesh.stages, colour=veil is None or mesh is veil)
        drawing.set_pipeline(pipeline)
        drawing.set_bind_group(0, _group(pipeline, 0, shared))
        maps = {at: _view(image) for at, image in zip((1, 2, 3, 5), mesh.maps, strict=True) if image is not None}
        own = {0: {"buffer": buffer(mesh.material, BufferUsage.UNIFORM)}} | maps
        own |= {4: _sampler(mesh.wrap)} if maps else {}
        drawing.set_bind_group(1, _group(pipeline, 1, own))
        drawing.set_vertex_buffer(0, buffer(mesh.vertices, BufferUsage.VERTEX))
        drawing.set_index_buffer(buffer(mesh.indices, BufferUsage.INDEX), "uint32")
        drawing.draw_indexed(mesh.indices.size)
    drawing.end()
    device.queue.submit([encoder.finish()])
    layout = {"bytes_per_row": width * 16, "rows_per_image": height}
    data = device.queue.read_texture({"texture": picture}, layout, (width, height, 1))
    return np.frombuffer(data, np.float32).reshape(height, width, 4)


@functools.cache
def _pipeline(stages: tuple[Stage, Stage], colour: bool) -> Any:
    """A pipeline that writes depth, and colour if it is asked to."""
    vertex, fragment = (
        {"module": _device().create_shader_module(code=stage.code), "entry_point": stage.entry} for stage in stages
    )
    formats = [f"float32x{count}" for count in (3, 3, 2, 2, 4, 2, 2, 4)]
    offsets = (0, 12, 24, 32, 40, 56, 64, 72)
    attributes = [
        {"shader_location": k, "offset": at, "format": of}
        for k, (at, of) in enumerate(zip(offsets, formats, strict=True))
    ]
    target = {"format": "rgba32float", "write_mask": 15 if colour else 0}
    return _device().create_render_pipeline(
        layout="auto",
        vertex=vertex | {"buffers": [{"array_stride": 88, "attributes": attributes}]},
        fragment=fragment | {"targets": [target]},
        depth_stencil={"format": "depth32float", "depth_write_enabled": True, "depth_compare": "less"},
    )


def _group(pipeline: Any, number: int, resources: Mapping[int, Any]) -> Any:
    entries = [{"binding": binding, "resource": resource} for binding, resource in resources.items()]
    return _device().create_bind_group(layout=pipeline.get_bind_group_layout(number), entries=entries)


def _sampler(wrap: tuple[str, str] = ("clamp-to-edge", "clamp-to-edge")) -> Any:
    """Linear in all ways."""
    linear = dict.fromkeys(("mag_filter", "min_filter", "mipmap_filter"), "linear")
    return _device().create_sampler(address_mode_u=wrap[0], address_mode_v=wrap[1], **linear)


def _view(image: Image) -> Any:
    """A texture on the device."""
    from wgpu import TextureUsage

    device = _device()
    layers, height, width, _ = image.levels[0].shape
    texture = device.create_texture(
        size=(width, height, layers),
        mip_level_count=len(image.levels),
        format="rgba16float",
        usage=TextureUsage.TEXTURE_BINDING | TextureUsage.COPY_DST,
    )
    for mip, level in enumerate(image.levels):
        layers, height, width, _ = level.shape
        layout = {"bytes_per_row": width * 8, "rows_per_image": height}
        device.queue.write_texture({"texture": texture, "mip_level": mip}, level, layout, (width, height, layers))
    return texture.create_view(dimension=image.dimension)
