"""Runs the optimisation step on torch, on a processor or a CUDA device, from the arrays onnxruntime takes.

It is the reference that the exported graph is compared with, and the way onto a GPU.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.imaging.ats.problem import (
    MAGNITUDE_FLOOR,
    Array,
    FieldWeights,
    FineRange,
    GridArrays,
    ViewArrays,
)
from tagid.imaging.ats.taps import BETA1, BETA2, SMALLEST


class Step(NamedTuple):
    """Everything that one step reads; all float32 tensors.

    Attributes:
        tables: one (features, k, k) table of vertex features a level.
        weights, biases: of the layers, (out, in) and (out, 1); the last has 2C outputs, the real parts of C
            channels of the reflectivity before the imaginary ones.
        first, second: Adam's moments, one tensor a parameter in the order tables, weights, biases.
        interpolation: one (pixels, k) matrix a level, the same along x and y.
        support: (1, P) 1 for pixels that the step works on, 0 for those that are zero.
        index: (V, P) int32, fine range bin of every pixel (row-major) in every view.
        real, imaginary: (V, 2C) what a view sees of the channels.
        transmission: (V, P) or (1, 1), what is left of a point's echo on its way through the scene.
        spread: (fine bins, 2B) carrier and range response, real part before imaginary part.
        samples: (2, V, B) measured scans, real and imaginary part.
        confidence: (V, B) weight of every sample.
        numbers: (7,) learning rate, Adam's two bias corrections, scale of the output, weights of data and
            sparsity terms, Adam's epsilon relative to the largest gradient of a tensor.
    """

    tables: list[Any]
    weights: list[Any]
    biases: list[Any]
    first: list[Any]
    second: list[Any]
    interpolation: list[Any]
    support: Any
    index: Any
    real: Any
    imaginary: Any
    transmission: Any
    spread: Any
    samples: Any
    confidence: Any
    numbers: Any


def features(tables: list[Any], interpolation: list[Any]) -> Any:
    """(levels * features, P): bilinear interpolation of every level, which on a grid is two products."""
    levels = [
        torch.matmul(torch.matmul(at, table), at.t()).flatten(1)
        for table, at in zip(tables, interpolation, strict=True)
    ]
    return torch.cat(levels, 0)


def activations(inputs: Any, weights: list[Any], biases: list[Any]) -> list[Any]:
    """Input, every hidden layer after its ReLU, and the output, each (units, P)."""
    layers = [inputs]
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        linear = torch.matmul(weight, layers[-1]) + bias
        layers.append(torch.relu(linear) if i < len(weights) - 1 else linear)
    return layers


def optimise(s: Step) -> tuple[Any, ...]:
    """Loss and updated state: (loss, tables.., weights.., biases.., first.., second..).

    loss = a sum c |A sigma - y|^2 + l sum_p |sigma_p|, where A puts every point into the nearest fine range
    bin of every view and applies carrier and response there.
    """
    layers = activations(features(s.tables, s.interpolation), s.weights, s.biases)
    sigma = layers[-1] * s.numbers[3] * s.support
    data, slope = _data_term(s, sigma)
    sparsity, pull = _sparsity(sigma, s)
    loss = data + sparsity
    grads = _backwards(s, layers, (slope + pull) * s.numbers[3] * s.support)
    return (loss.reshape(1), *_adam(s, grads))


def _data_term(s: Step, sigma: Any) -> tuple[Any, Any]:
    """a sum c |A sigma - y|^2 and its gradient by sigma (2C, P)."""
    views, fine = s.index.shape[0], s.spread.shape[0]
    index = s.index.to(torch.int64)
    empty = torch.zeros((views, fine), dtype=sigma.dtype, device=sigma.device)
    rows = torch.cat(
        [
            empty.scatter_add(1, index, torch.matmul(s.real, sigma) * s.transmission),
            empty.scatter_add(1, index, torch.matmul(s.imaginary, sigma) * s.transmission),
        ],
        0,
    )
    seen = torch.matmul(rows, s.spread).reshape(2, views, 2, -1)
    residual_re = seen[0, :, 0] - seen[1, :, 1] - s.samples[0]
    residual_im = seen[0, :, 1] + seen[1, :, 0] - s.samples[1]
    weight = s.confidence * s.numbers[4]
    loss = (weight * (residual_re.square() + residual_im.square())).sum()
    back_re, back_im = 2 * weight * residual_re, 2 * weight * residual_im
    back = torch.cat([torch.cat([back_re, back_im], 1), torch.cat([back_im, -back_re], 1)], 0)
    fine_rows = torch.matmul(back, s.spread.t()).reshape(2, views, -1)
    slope = torch.matmul(s.real.t(), torch.gather(fine_rows[0], 1, index) * s.transmission)
    slope = slope + torch.matmul(s.imaginary.t(), torch.gather(fine_rows[1], 1, index) * s.transmission)
    return loss, slope


def _sparsity(sigma: Any, s: Step) -> tuple[Any, Any]:
    """l sum |sigma| over the pixels, the channels of a pixel taken together, and its gradient."""
    floor = (s.numbers[3] * MAGNITUDE_FLOOR).square()
    magnitude = (sigma.square().sum(0, keepdim=True) + floor).sqrt()
    return s.numbers[5] * magnitude.sum(), s.numbers[5] * sigma / magnitude


def _backwards(s: Step, layers: list[Any], slope: Any) -> list[Any]:
    """Gradients by tables, weights and biases from that by the network's output (2C, P)."""
    by_weight: list[Any] = []
    by_bias: list[Any] = []
    for i in range(len(s.weights) - 1, -1, -1):
        by_weight.insert(0, torch.matmul(slope, layers[i].t()))
        by_bias.insert(0, slope.sum(1, keepdim=True))
        slope = torch.matmul(s.weights[i].t(), slope)
        if i > 0:
            slope = slope * (layers[i] > 0).to(slope.dtype)
    count = s.tables[0].shape[0]
    by_table = []
    for level, at in enumerate(s.interpolation):
        part = slope[level * count : (level + 1) * count].reshape(count, at.shape[0], at.shape[0])
        by_table.append(torch.matmul(torch.matmul(at.t(), part), at))
    return by_table + by_weight + by_bias


def _adam(s: Step, grads: list[Any]) -> list[Any]:
    """Parameters and both moments after Adam's update, in the order of `Step`.

    Adam's epsilon is relative to the largest gradient of its tensor: with an absolute one, pixels that the
    data hardly see move as fast as bright ones, on rounding alone.
    """
    parameters = [*s.tables, *s.weights, *s.biases]
    first = [BETA1 * m + (1 - BETA1) * g for m, g in zip(s.first, grads, strict=True)]
    second = [BETA2 * v + (1 - BETA2) * g * g for v, g in zip(s.second, grads, strict=True)]
    rate = s.numbers[0] * s.numbers[1]
    moved = []
    for p, m, v in zip(parameters, first, second, strict=True):
        size = (v * s.numbers[2]).sqrt()
        moved.append(p - rate * m / (size + s.numbers[6] * size.max() + SMALLEST))
    return moved + first + second


class TorchEngine:
    """Parameters and Adam's moments of a fit on torch, on "cpu", "cuda" or "cuda:N".

    Raises:
        UsageError: the device is not there.
    """

    name = "torch"

    def __init__(self, weights: FieldWeights, device: str = "cpu", threads: int = 1) -> None:
        self._device = _device(device)
        self._threads = threads
        self._start = weights
        self._levels, self._layers = len(weights.tables), len(weights.weights)
        arrays = weights.arrays
        self._state = [torch.tensor(a, device=self._device) for a in arrays]
        self._state += [torch.zeros_like(a) for a in self._state * 2]
        self._constants: dict[int, tuple[NDArray[Any], Any]] = {}

    def step(self, grid: GridArrays, views: ViewArrays, fine: FineRange, numbers: Array) -> float:
        count = self._levels + 2 * self._layers
        parameters = self._state[:count]
        state = Step(
            tables=parameters[: self._levels],
            weights=parameters[self._levels : self._levels + self._layers],
            biases=parameters[self._levels + self._layers :],
            first=self._state[count : 2 * count],
            second=self._state[2 * count :],
            interpolation=[self._constant(a) for a in grid.interpolation],
            support=self._constant(grid.support),
            index=self._constant(views.index),
            real=self._constant(views.real),
            imaginary=self._constant(views.imaginary),
            transmission=self._constant(views.transmission),
            spread=self._constant(fine.spread),
            samples=self._constant(views.samples),
            confidence=self._constant(views.confidence),
            numbers=torch.from_numpy(numbers).to(self._device),
        )
        before = torch.get_num_threads()
        torch.set_num_threads(self._threads)
        try:
            with torch.no_grad():
                loss, *self._state = optimise(state)
                return float(loss.item())
        finally:
            torch.set_num_threads(before)

    def weights(self) -> FieldWeights:
        arrays: list[NDArray[np.float32]] = [a.cpu().numpy().copy() for a in self._state]
        return replace(self._start.with_arrays(arrays[: self._levels + 2 * self._layers]), support=None)

    def _constant(self, array: NDArray[Any]) -> Any:
        """The array on the device; sent there once."""
        kept = self._constants.get(id(array))
        if kept is None:
            kept = (array, torch.from_numpy(array).to(self._device))
            self._constants[id(array)] = kept
        return kept[1]


def _device(name: str) -> Any:
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UsageError(f"there is no device {name!r}", "Use cpu, cuda or cuda:N.") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            f"device {name} is not available to torch {torch.__version__}",
            "Install a torch built for CUDA and its driver, or use `device=cpu`.",
        )
    if device.type not in ("cpu", "cuda"):
        raise UsageError(f"device {name} is not supported", "Use cpu, cuda or cuda:N.")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UsageError(f"there is no device {name}", f"Use cuda:0 to cuda:{torch.cuda.device_count() - 1}.")
    return device
