"""The metrics in the manifest against those recomputed from the KTX2 file and a Zarr store by independent code."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import zarr

from kiln_schemas.settings import Function
from kiln_workers.package.build import build_package
from kiln_workers.sphere import octahedral

_SPEC = importlib.util.spec_from_file_location("recompute", Path(__file__).with_name("recompute.py"))
assert _SPEC is not None
assert _SPEC.loader is not None
recompute = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(recompute)


@pytest.mark.parametrize("function", list(Function))
def test_the_package_is_as_good_as_its_manifest_says(function: Function, make_sample, tmp_path: Path) -> None:
    sample = make_sample()
    build_package(tmp_path / "package", sample.given)
    store = zarr.open_group(tmp_path / "store", mode="w")
    store.create_array("state", data=np.where(sample.texel_map.state > 0, 1, 0).astype(np.uint8))
    store.create_array("normal", data=sample.texel_map.normal)
    store.create_array(function.value, data=sample.images[function])
    log_mse, zero, relative = recompute.recompute(tmp_path / "package", tmp_path / "store", function.value)
    expected = sample.given.metrics[function]
    assert log_mse == pytest.approx(expected.log_mse, rel=1e-4)
    assert zero == pytest.approx(expected.log_mse_zero, rel=1e-4)
    assert relative == pytest.approx(expected.log_mse_rel, rel=1e-4)
    # The lobes' noise is the images' own: a relative error far from both 0 and 1.
    assert 0.001 < relative < 0.2


def test_its_octahedral_map_is_the_same_map() -> None:
    directions, solid_angles = recompute.octahedral_pixels(16)
    np.testing.assert_allclose(directions, octahedral.pixel_directions(16), atol=1e-12)
    np.testing.assert_allclose(solid_angles, octahedral.pixel_solid_angles(16), rtol=2e-3)
    assert solid_angles.sum() == pytest.approx(4.0 * np.pi, rel=1e-4)
