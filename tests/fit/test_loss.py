"""The fast loss against the formula, the parametrisation's bounds, and the network's shape."""

import math

import numpy as np
import pytest
import torch

from kiln_workers.fit.lobes import LOG_AMPLITUDE, LOG_SHARPNESS, constrain, fibonacci_axes
from kiln_workers.fit.loss import draw_sample, log_loss, reference_loss, sample_weights
from kiln_workers.fit.network import Shape, encode, initial_parameters, network_input, split
from kiln_workers.sphere import octahedral


def random_normals(count: int) -> torch.Tensor:
    values = np.random.default_rng(3).standard_normal((count, 3))
    return torch.from_numpy((values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32))


@pytest.mark.parametrize("scale", [0.0, 1.0, 1e3, 1e6])
def test_any_output_is_a_lobe_within_bounds(scale: float) -> None:
    raw = scale * torch.from_numpy(np.random.default_rng(0).standard_normal((50, 16, 7)).astype(np.float32))
    lobes = constrain(raw, random_normals(50))
    np.testing.assert_allclose(lobes[..., :3].norm(dim=-1).numpy(), 1.0, atol=1e-5)
    for part, (low, high) in ((lobes[..., 3], LOG_SHARPNESS), (lobes[..., 4:], LOG_AMPLITUDE)):
        assert part.min() >= math.exp(low) * 0.999 and part.max() <= math.exp(high) * 1.001
    assert torch.isfinite(lobes.half()).all() and (lobes.half()[..., 3] > 0).all()


def test_lobes_start_above_the_horizon_with_an_even_picture() -> None:
    normals = random_normals(20)
    lobes = constrain(torch.zeros(20, 16, 7), normals)
    assert (torch.einsum("tnd,td->tn", lobes[..., :3], normals) > 0).all()
    np.testing.assert_allclose(lobes[..., 3].numpy(), 16.0, rtol=1e-4)
    np.testing.assert_allclose(lobes[..., 4:].numpy(), 0.05, rtol=1e-4)
    axes = fibonacci_axes(64).numpy()
    np.testing.assert_allclose(axes.mean(axis=0), 0.0, atol=0.02)


def test_fast_loss_and_gradient_are_the_formulas() -> None:
    rng = np.random.default_rng(5)
    normals = random_normals(6)
    sample = draw_sample(16, 1, rng)
    weights = sample_weights(sample, normals)
    targets = torch.from_numpy(rng.random((6, 256, 3)) * 2.0)
    raw = torch.from_numpy(rng.standard_normal((6, 8, 7)))
    results = []
    for loss_of in (log_loss, reference_loss):
        lobes = constrain(raw.float(), normals).double().requires_grad_()
        loss = loss_of(lobes, targets, sample.directions.double(), weights.double())
        results.append((loss.detach(), torch.autograd.grad(loss, lobes)[0]))
    np.testing.assert_allclose(results[0][0].numpy(), results[1][0].numpy(), rtol=1e-12)
    np.testing.assert_allclose(results[0][1].numpy(), results[1][1].numpy(), rtol=1e-9, atol=1e-12)
    assert results[0][1].abs().max() > 1e-3


def test_a_sample_lies_in_its_pixels_and_covers_the_sphere_on_average() -> None:
    rng = np.random.default_rng(6)
    seen = torch.zeros(256)
    for _ in range(400):
        sample = draw_sample(16, 2, rng)
        assert len(sample.pixels) == 64
        place = (octahedral.encode(sample.directions.double().numpy()) + 1.0) * 8.0
        inside = place - np.stack([sample.pixels.numpy() % 16, sample.pixels.numpy() // 16], axis=1)
        assert inside.min() > -1e-4 and inside.max() < 1.0 + 1e-4
        seen[sample.pixels] += sample.solid_angles / 400
    exact = octahedral.pixel_solid_angles(16).reshape(-1)
    np.testing.assert_allclose(seen.numpy(), exact, rtol=0.45)  # 5 sigma of 400 draws with probability 1/4
    assert float(seen.sum()) == pytest.approx(4.0 * np.pi, rel=0.005)


def test_weights_leave_out_what_is_below_the_horizon() -> None:
    sample = draw_sample(32, 1, np.random.default_rng(7))
    normals = random_normals(10)
    weights = sample_weights(sample, normals)
    below = normals @ sample.directions.T <= 0.0
    assert below.any() and (weights[below] == 0.0).all()
    np.testing.assert_allclose(weights.sum(dim=1).numpy(), 2.0 * np.pi, rtol=0.05)


def test_the_network_is_the_papers() -> None:
    shape = Shape(image_size=128, lobes=16)
    assert [layer[0] for layer in shape.layers[:8:2]] == [32, 64, 128, 256]
    assert shape.layers[8] == (16 * 7, 8 * 8 * 256)
    small = Shape(image_size=16, lobes=3)
    layers = split(small, initial_parameters(small, 0))
    images = torch.rand(2, 16, 16, 3)
    hidden = network_input(images, random_normals(2), 2.0)
    assert hidden.shape == (2, 4, 16, 16)
    np.testing.assert_allclose(hidden[:, :3].permute(0, 2, 3, 1).numpy(), np.log1p(2.0 * images.numpy()), rtol=1e-5)
    output = encode(layers, hidden)
    for weight, bias in zip(layers[:-2:2], layers[1:-2:2], strict=True):
        convolution = torch.nn.Conv2d(weight.shape[3], weight.shape[0], 3, padding=1)
        convolution.weight.data = weight.permute(0, 3, 1, 2).contiguous()
        convolution.bias = torch.nn.Parameter(bias)
        hidden = torch.nn.MaxPool2d(2)(torch.relu(convolution(hidden)))
    expected = hidden.flatten(1) @ layers[-2].T + layers[-1]  # 1 x 1 x 256: no order of pixels to mind
    np.testing.assert_allclose(output.flatten(1).numpy(), expected.detach().numpy(), atol=1e-5)
