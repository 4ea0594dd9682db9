"""Encoding, network and differentiable forward model of analysis through synthesis, each against truth.

The encoding is compared with an interpolation written out point by point, the gradients with numerical ones.
"""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="analysis through synthesis needs the extra 'ats'")

from tagid.imaging.ats.fit_paper import (  # noqa: E402
    EncodingSettings,
    ReflectivityNetwork,
    encoding_matrix,
    interpolate,
    level_sizes,
    vertex_entry,
)


def drawn_table(settings: EncodingSettings, seed: int) -> torch.Tensor:
    shape = sum(level_sizes(settings)), settings.features
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), requires_grad=True)


def interpolate_directly(point: np.ndarray, table: np.ndarray, settings: EncodingSettings) -> np.ndarray:
    """Features of one point, corner by corner."""
    out, offset = [], 0
    for cells, size in zip(settings.resolutions(), level_sizes(settings), strict=True):
        level = table[offset : offset + size]
        x, y = point * cells
        i, j = min(int(x), cells - 1), min(int(y), cells - 1)
        u, v = x - i, y - j
        feature = np.zeros(settings.features)
        for a, b, weight in (
            (i, j, (1 - u) * (1 - v)),
            (i, j + 1, (1 - u) * v),
            (i + 1, j, u * (1 - v)),
            (i + 1, j + 1, u * v),
        ):
            entry = vertex_entry(np.array([[a, b]]), cells, settings)[0]
            feature += weight * level[entry]
        out.append(feature)
        offset += size
    return np.concatenate(out)


@pytest.mark.parametrize("log2_entries", [14, 6], ids=["dense", "hashed"])
def test_encoding_equals_direct_interpolation(log2_entries: int) -> None:
    settings = EncodingSettings(levels=5, features=3, coarsest=4, finest=40, log2_entries=log2_entries)
    points = np.random.default_rng(0).uniform(0, 1, (50, 2))
    points[:4] = [[0, 0], [1, 1], [0, 1], [0.5, 0.25]]
    drawn = drawn_table(settings, 3)
    matrix = encoding_matrix(points, settings)
    features = interpolate(drawn, matrix, matrix.T, settings).detach().numpy()
    table = drawn.detach().numpy()
    assert features.shape == (50, settings.width)
    expected = np.stack([interpolate_directly(p, table, settings) for p in points])
    np.testing.assert_allclose(features, expected, atol=1e-7)


def test_dense_levels_have_no_collisions_and_hashed_ones_stay_in_their_table() -> None:
    settings = EncodingSettings(levels=2, coarsest=8, finest=100, log2_entries=8)
    corners = np.stack(np.meshgrid(np.arange(9), np.arange(9)), -1).reshape(-1, 2)
    assert sorted(vertex_entry(corners, 8, settings)) == list(range(81))
    many = np.stack(np.meshgrid(np.arange(101), np.arange(101)), -1).reshape(-1, 2)
    hashed = vertex_entry(many, 100, settings)
    assert hashed.min() >= 0
    assert hashed.max() < 256
    assert len(set(hashed)) > 200
    assert level_sizes(settings) == [81, 256]


def test_bilinear_interpolation_reproduces_a_plane() -> None:
    settings = EncodingSettings(levels=1, features=1, coarsest=7, finest=7)
    points = np.random.default_rng(1).uniform(0, 1, (30, 2))
    vertices = np.stack(np.meshgrid(np.arange(8), np.arange(8), indexing="ij"), -1).reshape(-1, 2)
    table = np.empty(64)
    table[vertex_entry(vertices, 7, settings)] = vertices @ [2.0, -3.0] / 7
    np.testing.assert_allclose(encoding_matrix(points, settings) @ table, points @ [2.0, -3.0], atol=1e-6)


def test_encoding_gradient_is_the_transpose() -> None:
    settings = EncodingSettings(levels=3, features=2, coarsest=4, finest=16)
    points = np.random.default_rng(2).uniform(0, 1, (20, 2))
    matrix = encoding_matrix(points, settings)
    table = drawn_table(settings, 0)
    weight = torch.rand(20, settings.width, generator=torch.Generator().manual_seed(1))
    (interpolate(table, matrix, matrix.T, settings) * weight).sum().backward()
    expected = matrix.T @ weight.numpy().reshape(-1, settings.features)
    np.testing.assert_allclose(table.grad.numpy(), expected, rtol=1e-5, atol=1e-6)


def test_network_is_the_written_out_product_and_leaves_the_global_random_state() -> None:
    before = torch.random.get_rng_state()
    network = ReflectivityNetwork(6, 8, 2, torch.Generator().manual_seed(5))
    assert torch.equal(before, torch.random.get_rng_state())
    x = np.random.default_rng(0).standard_normal((11, 6)).astype(np.float32)
    with torch.no_grad():
        out = network(torch.from_numpy(x)).numpy()
    h = x
    for i, (w, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        h = h @ w.detach().numpy() + b.detach().numpy()
        h = np.where(h > 0, h, 0.01 * h) if i < 2 else h
    assert out.dtype == np.complex64
    np.testing.assert_allclose(out, h[:, 0] + 1j * h[:, 1], atol=1e-5)
