"""The optimisation step on numpy and compiled kernels, the fastest on a processor, or by onnxruntime.

It computes what `fit_torch.optimise` does; tests compare the two. Three differences only save time: a
point lies between two fine range bins where the graph takes the nearest, pixels outside the support are left
out where the graph sets them to zero, and all parameters share one array, so that Adam is one update.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.imaging.ats.problem import (
    MAGNITUDE_FLOOR,
    Array,
    FieldWeights,
    FineRange,
    GridArrays,
    ViewArrays,
)
from tagid.imaging.ats.settings import LEVELS
from tagid.imaging.ats.taps import Adam
from tagid.models_store import open_model


class NativeEngine:
    """Parameters and Adam's moments of a fit.

    All parameters follow each other in one array; a table is stored with the features of a vertex side by
    side, (vertices, features).
    """

    name = "native"

    def __init__(self, weights: FieldWeights) -> None:
        self._start, self._features = weights, len(weights.tables[0])
        arrays = [*(np.moveaxis(t, 0, 2) for t in weights.tables), *weights.weights, *weights.biases]
        sizes = [a.size for a in arrays]
        self._cut = sum(sizes[:-4])
        self._all = np.concatenate([a.ravel() for a in arrays])
        self._adam = Adam.of(sizes)
        self._state = self._parts(self._all)
        self._first = self._parts(self._adam.first)
        self._gradient = np.empty_like(self._all)
        self._by_layer = self._parts(self._gradient)[-4:]
        self._kept: dict[int, tuple[list[Array], list[Array]]] = {}

    def _parts(self, whole: Array) -> list[Array]:
        """Views of an array of all parameters, in the shapes and the order of `FieldWeights`."""
        start = self._start
        shapes = [a.shape for a in (*start.tables, *start.weights, *start.biases)]
        parts: list[Array] = []
        at = 0
        for number, (size, shape) in enumerate(zip(self._adam.sizes, shapes, strict=True)):
            part = whole[at : at + size]
            at += size
            if number < len(start.tables):
                parts.append(part.reshape(*shape[1:], shape[0]).transpose(2, 0, 1))
            else:
                parts.append(part.reshape(shape))
        return parts

    def step(self, grid: GridArrays, views: ViewArrays, fine: FineRange, numbers: Array) -> float:
        """One step of Adam on some views, on the pixels of `grid.pixels`; the loss before it."""
        scale, data, sparsity = (float(n) for n in numbers[3:6])
        layers = self._forward(grid)
        sigma = layers[-1] * np.float32(scale)
        loss, slope = _data_term(sigma, views, fine, data)
        square = np.einsum("pc,pc->p", sigma, sigma)
        magnitude = np.sqrt(square + np.float32((scale * MAGNITUDE_FLOOR) ** 2))[:, None]
        loss += sparsity * float(magnitude.sum())
        slope += sigma * (np.float32(sparsity) / magnitude)
        slope *= np.float32(scale)
        rate, first, second = (np.float32(n) for n in numbers[:3])
        rates = np.full(len(self._adam.sizes), rate * first, dtype=np.float32)
        gradient = self._backward(grid, layers, slope)
        self._adam.update(self._all, gradient, rates, float(second), float(numbers[6]))
        return loss

    def weights(self) -> FieldWeights:
        return replace(self._start.with_arrays(self._parts(self._all.copy())), support=None)

    def _scratch(self, points: int) -> tuple[list[Array], list[Array]]:
        """Arrays (points, units) of the features and of both layers, for values and for slopes.

        They are kept from step to step: half of a step's time would go into fresh memory.
        """
        kept = self._kept.get(points)
        if kept is None:
            units = [len(self._start.tables) * self._features, *(len(w) for w in self._start.weights)]
            values, slopes = ([np.empty((points, n), dtype=np.float32) for n in units] for _ in range(2))
            kept = self._kept[points] = values, slopes
        return kept

    def _forward(self, grid: GridArrays) -> list[Array]:
        """Features, the hidden layer after its ReLU, and the output, each (P, units)."""
        outputs, _ = self._scratch(len(grid.taps.index))
        features, hidden, output = outputs
        weight, last_weight, bias, last_bias = self._state[-4:]
        grid.taps.interpolate(self._all[: self._cut].reshape(-1, self._features), features)
        np.matmul(features, weight.T, out=hidden)
        hidden += bias.T
        np.maximum(hidden, 0, out=hidden)
        np.matmul(hidden, last_weight.T, out=output)
        output += last_bias.T
        return outputs

    def _backward(self, grid: GridArrays, layers: list[Array], slope: Array) -> Array:
        """Gradient by all parameters from that by the network's output (P, 2)."""
        features, hidden, _ = layers
        weight, last_weight = self._state[-4:-2]
        by_weight, by_last_weight, by_bias, by_last_bias = self._by_layer
        _, (by_features, by_hidden, _) = self._scratch(len(slope))
        # A product with ones: numpy's sum over the long axis takes ten times as long.
        ones = np.ones(len(slope), dtype=np.float32)
        np.matmul(slope.T, hidden, out=by_last_weight)
        by_last_bias[:, 0] = ones @ slope
        np.matmul(slope, last_weight, out=by_hidden)
        by_hidden *= hidden > 0
        np.matmul(by_hidden.T, features, out=by_weight)
        by_bias[:, 0] = ones @ by_hidden
        np.matmul(by_hidden, weight, out=by_features)
        grid.taps.accumulate(by_features, self._gradient[: self._cut].reshape(-1, self._features))
        return self._gradient


def _data_term(sigma: Array, views: ViewArrays, fine: FineRange, scale: float) -> tuple[float, Array]:
    """a sum c |A sigma - y|^2 and its gradient by sigma (P, 2)."""
    residual = views.rows_of(sigma.view(np.complex64)[:, 0]) @ fine.complex_spread
    residual -= views.measured
    weighted = residual * (views.confidence * np.float32(scale))
    loss = float(np.vdot(residual, weighted).real)
    weighted *= 2
    back = views.points_of(np.asarray(weighted @ fine.complex_collect, dtype=np.complex64))
    return loss, back.view(np.float32).reshape(-1, 2)


MODEL = "ats_step"
"""The shipped graph; all but the numbers of levels and layers is dynamic in it."""


def parameter_names() -> list[str]:
    """Names of the parameters in the order tables, weights, biases."""
    return [*(f"table_{i}" for i in range(LEVELS)), "weight_0", "weight_1", "bias_0", "bias_1"]


def state_names() -> list[str]:
    """Names of what a step gives back after the loss."""
    return [
        f"{prefix}{name}" for prefix in ("new_", "new_first_", "new_second_") for name in parameter_names()
    ]


class OnnxEngine:
    """Parameters and Adam's moments of a fit on onnxruntime. ModelError: the shipped graph is damaged."""

    name = "onnx"

    def __init__(self, weights: FieldWeights, threads: int = 1) -> None:
        self._model = open_model(MODEL, threads)
        self._start = weights
        arrays = weights.arrays
        zeros = [a * 0 for a in arrays]
        state = [f"{prefix}{name}" for prefix in ("", "first_", "second_") for name in parameter_names()]
        self._state: dict[str, Array] = dict(zip(state, [*arrays, *zeros, *zeros], strict=True))
        self._names = list(zip(state, state_names(), strict=True))
        self._checked: set[tuple[int, int]] = set()

    def step(self, grid: GridArrays, views: ViewArrays, fine: FineRange, numbers: Array) -> float:
        feeds: dict[str, NDArray[Any]] = dict(self._state)
        feeds |= {f"interpolation_{i}": a for i, a in enumerate(grid.interpolation)}
        feeds |= {
            "support": grid.support,
            "index": views.index,
            "real": views.real,
            "imaginary": views.imaginary,
            "transmission": views.transmission,
            "spread": fine.spread,
            "samples": views.samples,
            "confidence": views.confidence,
            "numbers": numbers,
        }
        kind = views.index.shape
        if kind not in self._checked:
            self._model.check(feeds)
            self._checked.add(kind)
        outputs = self._model.run(feeds)
        self._state = {old: outputs[new] for old, new in self._names}
        return float(outputs["loss"][0])

    def weights(self) -> FieldWeights:
        parameters = self._start.with_arrays([self._state[name] for name in parameter_names()])
        return replace(parameters, support=None)
