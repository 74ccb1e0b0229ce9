"""The camera of a glTF file: the first perspective one, where its node puts it."""

import json

import numpy as np
import pytest

from kiln_schemas.camera import Camera
from kiln_workers.scene.file_camera import file_camera
from kiln_workers.scene.gltf_camera import gltf_camera
from kiln_workers.shade.camera import camera_frame

HALF = float(np.sqrt(0.5))
PERSPECTIVE = {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}
ORTHOGRAPHIC = {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "znear": 0.1, "zfar": 9}}


def document(cameras: list[object], nodes: list[dict[str, object]]) -> bytes:
    roots = [index for index in range(len(nodes)) if not any(index in node.get("children", ()) for node in nodes)]
    content = {"asset": {"version": "2.0"}, "scenes": [{"nodes": roots}], "nodes": nodes, "cameras": cameras}
    return json.dumps(content).encode()


def test_it_stands_where_its_node_is() -> None:
    """A parent at (5, 0, 0) turns a quarter about +Y; the camera is 2 m along the parent's Z, which is world X."""
    nodes = [
        {"children": [1], "translation": [5, 0, 0], "rotation": [0, HALF, 0, HALF]},
        {"camera": 1, "translation": [0, 1, 2]},
    ]
    camera = gltf_camera(document([ORTHOGRAPHIC, PERSPECTIVE], nodes), "scene.gltf")
    assert camera is not None
    np.testing.assert_allclose(camera.position, [7.0, 1.0, 0.0], atol=1e-9)
    _, up, forward = camera_frame(camera)
    np.testing.assert_allclose(forward, [-1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(up, [0.0, 1.0, 0.0], atol=1e-9)
    assert camera.fov_deg == pytest.approx(np.degrees(0.7))


@pytest.mark.parametrize(
    ("cameras", "node"),
    [
        ([ORTHOGRAPHIC], {"camera": 0}),
        ([], {"camera": 3}),
        ([{"type": "perspective"}], {"camera": 0}),
        ([{"perspective": {"yfov": "wide"}}], {"camera": 0}),
        ([{"perspective": {"yfov": 4.0}}], {"camera": 0}),
        ([PERSPECTIVE], {"camera": 0, "scale": [0, 0, 0]}),
        (["no camera"], {"camera": 0}),
        ([PERSPECTIVE], {"camera": "0"}),
        ([PERSPECTIVE], {}),
    ],
)
def test_what_is_no_usable_camera_is_passed_over(cameras: list[object], node: dict[str, object]) -> None:
    assert gltf_camera(document(cameras, [node]), "scene.gltf") is None
    usable: Camera | None = gltf_camera(document([*cameras, PERSPECTIVE], [node, {"camera": len(cameras)}]), "s.gltf")
    assert usable is not None and usable.position == (0.0, 0.0, 0.0)


def test_other_formats_have_none() -> None:
    assert file_camera(b"v 0 0 0", "scene.obj") is None
