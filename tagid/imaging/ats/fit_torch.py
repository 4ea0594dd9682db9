"""Runs the optimisation step on torch, on a processor or a CUDA device, from the arrays onnxruntime takes.

It is the reference that the exported graph is compared with, and the way onto a GPU.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.imaging.ats.forward_step import Step, optimise
from tagid.imaging.ats.problem import Array, FieldWeights, FineRange, GridArrays, ViewArrays


class TorchEngine:
    """State of a fit on torch: parameters and Adam's moments.

    Args:
        weights: initial parameters; they are copied.
        device: "cpu", "cuda" or "cuda:N".
        threads: torch's threads on a processor.

    Raises:
        UsageError: the device is not there.
    """

    name = "torch"

    def __init__(self, weights: FieldWeights, device: str = "cpu", threads: int = 1) -> None:
        self._device = _device(device)
        self._threads = threads
        self._start = weights
        self._levels, self._layers = len(weights.tables), len(weights.weights)
        arrays = [*weights.tables, *weights.weights, *weights.biases]
        self._state = [torch.tensor(a, device=self._device) for a in arrays]
        self._state += [torch.zeros_like(a) for a in self._state * 2]
        self._constants: dict[int, tuple[NDArray[Any], Any]] = {}

    def step(self, grid: GridArrays, views: ViewArrays, fine: FineRange, numbers: Array) -> float:
        """One step of Adam on some views; the loss before it."""
        count = self._levels + 2 * self._layers
        parameters = self._state[:count]
        state = Step(
            tables=parameters[: self._levels],
            weights=parameters[self._levels : self._levels + self._layers],
            biases=parameters[self._levels + self._layers :],
            first=self._state[count : 2 * count],
            second=self._state[2 * count :],
            interpolation=[self._constant(a) for a in grid.interpolation],
            neighbours=self._constant(grid.neighbours),
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
        """The parameters as they are now."""
        arrays: list[NDArray[np.float32]] = [a.cpu().numpy().copy() for a in self._state]
        cut, layers = self._levels, self._layers
        return FieldWeights(
            arrays[:cut],
            arrays[cut : cut + layers],
            arrays[cut + layers : cut + 2 * layers],
            self._start.scale,
            self._start.extent,
            self._start.pixels,
        )

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
