"""HLSL and WGSL without a browser: Microsoft's DXC makes SPIR-V of HLSL, and wgpu runs SPIR-V and WGSL by way of naga.

wgpu draws on Vulkan, for which chromium brings a software driver and its loader. Meant to run in a process of its own
(`conftest.native`), as DXC exports an LLVM that others in the process may then take for theirs.
"""

import ctypes
import functools
import importlib.util
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import shader_probes

CHROMIUM = Path("/usr/lib/chromium")


@functools.cache
def _dxc():
    """DXC as its package has it; the module looks the library up among those that are loaded."""
    found = importlib.util.find_spec("compushady.backends")
    assert found is not None and found.submodule_search_locations is not None
    (library,) = Path(found.submodule_search_locations[0]).glob("libdxcompiler_*.so")
    ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)
    from compushady.backends import dxc

    return dxc


def compile_hlsl(source: str, entry: str, target: str) -> bytes:
    """SPIR-V of one stage; ValueError with DXC's messages where it does not compile."""
    spirv = 1
    return _dxc().compile(source.encode(), entry, spirv, target)


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


def run(code: str | bytes, inputs: np.ndarray, textures: Mapping[str, shader_probes.Image]) -> np.ndarray:
    """What a probe program writes: float32 [rows, P, 4]."""
    from wgpu import BufferUsage, TextureUsage

    device = _device()
    pipeline = device.create_compute_pipeline(
        layout="auto", compute={"module": device.create_shader_module(code=code), "entry_point": "main"}
    )
    given = device.create_buffer_with_data(data=inputs, usage=BufferUsage.STORAGE)
    rows, points = len(shader_probes.ROWS), len(inputs)
    results = device.create_buffer(size=rows * points * 16, usage=BufferUsage.STORAGE | BufferUsage.COPY_SRC)
    sampler = device.create_sampler(mag_filter="linear", min_filter="linear", mipmap_filter="linear")
    resources = [{"buffer": given}, {"buffer": results}, sampler]
    for image in textures.values():
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
        resources.append(texture.create_view(dimension=image.dimension))
    group = device.create_bind_group(
        layout=pipeline.get_bind_group_layout(0),
        entries=[{"binding": binding, "resource": resource} for binding, resource in enumerate(resources)],
    )
    encoder = device.create_command_encoder()
    compute = encoder.begin_compute_pass()
    compute.set_pipeline(pipeline)
    compute.set_bind_group(0, group)
    compute.dispatch_workgroups(points // 64, rows)
    compute.end()
    device.queue.submit([encoder.finish()])
    return np.frombuffer(device.queue.read_buffer(results), np.float32).reshape(rows, points, 4)
