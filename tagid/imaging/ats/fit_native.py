"""The optimisation step on numpy and the compiled kernel of the forward operator: the fastest on a processor.

It is `forward_step.optimise` written out once more; tests hold the two against each other. The kernel puts a
point between two fine range bins where the graph takes the nearest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.imaging.ats.problem import Array, FieldWeights, FineRange, GridArrays, ViewArrays

_BETA1, _BETA2, _SMALLEST, _MAGNITUDE_FLOOR = 0.9, 0.95, 1e-20, 1e-2
"""As `forward_step.BETA1`, `BETA2`, `SMALLEST` and `MAGNITUDE_FLOOR`, which need torch."""


class NativeEngine:
    """State of a fit: parameters and Adam's moments.

    Args:
        weights: initial parameters; they are copied.
    """

    name = "native"

    def __init__(self, weights: FieldWeights) -> None:
        self._start = weights
        self._levels, self._layers = len(weights.tables), len(weights.weights)
        self._state = [a.copy() for a in (*weights.tables, *weights.weights, *weights.biases)]
        self._first = [np.zeros_like(a) for a in self._state]
        self._second = [np.zeros_like(a) for a in self._state]

    def step(self, grid: GridArrays, views: ViewArrays, fine: FineRange, numbers: Array) -> float:
        """One step of Adam on some views; the loss before it."""
        scale, data, sparsity, smoothness = (float(n) for n in numbers[4:8])
        weights = self._state[self._levels : self._levels + self._layers]
        layers = self._forward(grid)
        sigma = layers[-1] * np.float32(scale)
        loss, slope = _data_term(sigma, views, fine, data)
        magnitude = np.sqrt((sigma * sigma).sum(axis=0) + np.float32((scale * _MAGNITUDE_FLOOR) ** 2))
        loss += sparsity * float(magnitude.sum())
        slope += np.float32(sparsity) * sigma / magnitude
        if smoothness > 0:
            pixels = len(grid.neighbours)
            image = sigma.reshape(-1, pixels, pixels)
            rough = np.float32(smoothness) * (grid.neighbours @ image + image @ grid.neighbours)
            loss += float((image * rough).sum())
            slope += 2 * rough.reshape(sigma.shape)
        self._adam(self._backward(grid, layers, weights, slope * np.float32(scale)), numbers)
        return loss

    def weights(self) -> FieldWeights:
        """The parameters as they are now."""
        arrays = [a.copy() for a in self._state]
        cut, layers = self._levels, self._layers
        return FieldWeights(
            arrays[:cut],
            arrays[cut : cut + layers],
            arrays[cut + layers :],
            self._start.scale,
            self._start.extent,
            self._start.pixels,
        )

    def _forward(self, grid: GridArrays) -> list[Array]:
        """Features, every hidden layer after its ReLU, and the output, each (units, P)."""
        tables = self._state[: self._levels]
        count, pixels = len(tables[0]), len(grid.neighbours)
        features = np.empty((self._levels * count, pixels, pixels), dtype=np.float32)
        for level, (table, at) in enumerate(zip(tables, grid.interpolation, strict=True)):
            np.matmul(at @ table, at.T, out=features[level * count : (level + 1) * count])
        found: list[Array] = [features.reshape(len(features), -1)]
        for number in range(self._layers):
            weight = self._state[self._levels + number]
            layer = weight @ found[-1]
            layer += self._state[self._levels + self._layers + number]
            if number < self._layers - 1:
                np.maximum(layer, 0, out=layer)
            found.append(layer)
        return found

    def _backward(
        self, grid: GridArrays, layers: list[Array], weights: list[Array], slope: Array
    ) -> list[Array]:
        """Gradients by tables, weights and biases from that by the network's output (2C, P)."""
        by_weight: list[Array] = []
        by_bias: list[Array] = []
        for number in range(self._layers - 1, -1, -1):
            by_weight.insert(0, slope @ layers[number].T)
            by_bias.insert(0, slope.sum(axis=1, keepdims=True))
            slope = weights[number].T @ slope
            if number > 0:
                slope *= layers[number] > 0
        pixels = len(grid.neighbours)
        parts = slope.reshape(self._levels, -1, pixels, pixels)
        by_table = [
            np.asarray(at.T @ part @ at, dtype=np.float32)
            for part, at in zip(parts, grid.interpolation, strict=True)
        ]
        return [*by_table, *by_weight, *by_bias]

    def _adam(self, gradients: list[Array], numbers: Array) -> None:
        tables, network, first, second = (np.float32(n) for n in numbers[:4])
        for number, gradient in enumerate(gradients):
            m, v, p = self._first[number], self._second[number], self._state[number]
            m *= np.float32(_BETA1)
            m += np.float32(1 - _BETA1) * gradient
            v *= np.float32(_BETA2)
            v += np.float32(1 - _BETA2) * gradient * gradient
            size = np.sqrt(v * second)
            rate = (tables if number < self._levels else network) * first
            p -= rate * m / (size + (numbers[8] * size.max() + np.float32(_SMALLEST)))


def _data_term(sigma: Array, views: ViewArrays, fine: FineRange, scale: float) -> tuple[float, Array]:
    """a sum c |A sigma - y|^2 and its gradient by sigma (2C, P)."""
    channels, bins = len(sigma) // 2, views.samples.shape[2]
    aspect = (views.real[:, :channels] + 1j * views.imaginary[:, :channels]).astype(np.complex64)
    spread = fine.complex_spread
    rows: NDArray[np.complex64] | None = None
    for channel in range(channels):
        seen = views.geometry.scatter(sigma[channel] + 1j * sigma[channels + channel])
        seen *= aspect[:, channel, None]
        rows = seen if rows is None else rows + seen
    assert rows is not None and spread.shape[1] == bins
    residual = rows @ spread - (views.samples[0] + 1j * views.samples[1])
    weighted = (views.confidence * np.float32(scale)) * residual
    loss = float(np.vdot(residual, weighted).real)
    back = (2 * weighted).astype(np.complex64) @ spread.conj().T
    slope = np.empty_like(sigma)
    for channel in range(channels):
        part = views.geometry.gather(aspect[:, channel, None].conj() * back)
        slope[channel], slope[channels + channel] = part.real, part.imag
    return loss, slope
