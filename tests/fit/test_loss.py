"""The fast loss against the formula, the parametrisation's bounds, and the network's shape."""

import math

import numpy as np
import pytest
import torch

from kiln_workers.fit.lobes import LOG_AMPLITUDE, LOG_SHARPNESS, constrain, fibonacci_axes
from kiln_workers.fit.loss import jittered_directions, log_loss, reference_loss, step_weights
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
    directions = jittered_directions(16, rng)
    weights = step_weights(directions, normals, 16)
    targets = torch.from_numpy(rng.random((6, 256, 3)) * 2.0)
    raw = torch.from_numpy(rng.standard_normal((6, 8, 7)))
    results = []
    for loss_of in (log_loss, reference_loss):
        lobes = constrain(raw.float(), normals).double().requires_grad_()
        loss = loss_of(lobes, targets, directions.double(), weights.double())
        results.append((loss.detach(), torch.autograd.grad(loss, lobes)[0]))
    np.testing.assert_allclose(results[0][0].numpy(), results[1][0].numpy(), rtol=1e-12)
    np.testing.assert_allclose(results[0][1].numpy(), results[1][1].numpy(), rtol=1e-9, atol=1e-12)
    assert results[0][1].abs().max() > 1e-3


def test_directions_are_uniform_inside_their_pixels() -> None:
    rng = np.random.default_rng(6)
    total = np.zeros((256, 2))
    for _ in range(400):
        place = (octahedral.encode(jittered_directions(16, rng).double().numpy()) + 1.0) * 8.0
        inside = place - np.stack([np.arange(256) % 16, np.arange(256) // 16], axis=1)
        assert inside.min() > -1e-4 and inside.max() < 1.0 + 1e-4
        total += inside / 400
    np.testing.assert_allclose(total, 0.5, atol=5.0 * np.sqrt(1.0 / 12.0 / 400))  # 5 sigma: false alarm 3e-4


def test_weights_leave_out_what_is_below_the_horizon() -> None:
    directions = jittered_directions(32, np.random.default_rng(7))
    normals = random_normals(10)
    weights = step_weights(directions, normals, 32)
    below = normals @ directions.T <= 0.0
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
