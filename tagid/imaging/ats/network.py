"""The small fully connected network that turns encoded coordinates into complex reflectivity.

It is tiny on purpose: with a hash encoding in front, it only mixes resolutions, and on a CPU its cost
decides the time of a step.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch

LEAK = 0.01
"""Slope of the hidden units below zero: with none, noise at times leaves every unit dark for good."""


class ReflectivityNetwork(torch.nn.Module):  # type: ignore[misc]
    """Linear layers with leaky ReLU between them and two outputs, real and imaginary part.

    The paper uses four layers; `hidden` counts those before the output. Weights are drawn from the given
    generator (uniform, variance 1 / (3 fan-in), torch's own default), so that the global random state stays
    untouched.
    """

    def __init__(self, inputs: int, width: int, hidden: int, generator: torch.Generator) -> None:
        super().__init__()
        sizes = [inputs] + [width] * hidden + [2]
        self.weights = torch.nn.ParameterList()
        self.biases = torch.nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise(sizes):
            bound = 1 / math.sqrt(fan_in)
            for store, shape in ((self.weights, (fan_in, fan_out)), (self.biases, (fan_out,))):
                drawn = torch.rand(*shape, generator=generator)
                store.append(torch.nn.Parameter((drawn * 2 - 1) * bound))

    def forward(self, features: Any) -> Any:
        """(P, inputs) float32 -> (P,) complex64."""
        x = features
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.addmm(bias, x, weight)
            if i < last:
                x = torch.nn.functional.leaky_relu(x, LEAK)
        return torch.view_as_complex(x)
