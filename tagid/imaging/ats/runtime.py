"""Runs the exported optimisation step on onnxruntime: the whole fit without torch.

The graph is `optimise` of `step`, exported with its gradient and Adam; this loop only feeds its outputs back.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.imaging.ats.problem import Array, FieldWeights, FineRange, GridArrays, ViewArrays
from tagid.models_store import open_model

MODEL = "ats_step"
LEVELS = 8
"""Levels of the encoding in the shipped graph; everything else about it is dynamic."""
HIDDEN = 1
"""Hidden layers in the shipped graph."""


def parameter_names(prefix: str = "") -> list[str]:
    """Names of the parameters in the order tables, weights, biases."""
    layers = range(HIDDEN + 1)
    names = [f"table_{i}" for i in range(LEVELS)]
    names += [f"weight_{i}" for i in layers] + [f"bias_{i}" for i in layers]
    return [prefix + name for name in names]


def state_names() -> list[str]:
    """Names of what a step gives back after the loss."""
    return [
        f"{prefix}{name}" for prefix in ("new_", "new_first_", "new_second_") for name in parameter_names()
    ]


def input_names() -> list[str]:
    """Names of the graph's inputs, in the order of `Step`."""
    state = [f"{prefix}{name}" for prefix in ("", "first_", "second_") for name in parameter_names()]
    grid = [f"interpolation_{i}" for i in range(LEVELS)]
    rest = [
        "neighbours",
        "support",
        "index",
        "real",
        "imaginary",
        "transmission",
        "spread",
        "samples",
        "confidence",
    ]
    return [*state, *grid, *rest, "numbers"]


class OnnxEngine:
    """State of a fit on onnxruntime: parameters and Adam's moments.

    Args:
        weights: initial parameters.
        threads: onnxruntime's threads.

    Raises:
        UsageError: the field has other levels or layers than the shipped graph.
        ModelError: the shipped graph is damaged.
    """

    name = "onnx"

    def __init__(self, weights: FieldWeights, threads: int = 1) -> None:
        levels, hidden = len(weights.tables), len(weights.weights) - 1
        if (levels, hidden) != (LEVELS, HIDDEN):
            raise UsageError(
                f"the shipped graph has {LEVELS} levels and {HIDDEN} hidden layers, not {levels}, {hidden}",
                "Leave levels and hidden layers at their defaults, or use `engine=torch`.",
            )
        self._model = open_model(MODEL, threads)
        self._start = weights
        arrays = [*weights.tables, *weights.weights, *weights.biases]
        zeros = [a * 0 for a in arrays]
        state = [f"{prefix}{name}" for prefix in ("", "first_", "second_") for name in parameter_names()]
        self._state: dict[str, Array] = dict(zip(state, [*arrays, *zeros, *zeros], strict=True))
        self._names = list(zip(state, state_names(), strict=True))
        self._checked: set[tuple[int, int]] = set()

    def step(self, grid: GridArrays, views: ViewArrays, fine: FineRange, numbers: Array) -> float:
        """One step of Adam on some views; the loss before it."""
        feeds: dict[str, NDArray[Any]] = dict(self._state)
        feeds |= {f"interpolation_{i}": a for i, a in enumerate(grid.interpolation)}
        feeds |= {
            "neighbours": grid.neighbours,
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
        found = self._model.run(feeds)
        self._state = {old: found[new] for old, new in self._names}
        return float(found["loss"][0])

    def weights(self) -> FieldWeights:
        """The parameters as they are now."""
        arrays = [self._state[name] for name in parameter_names()]
        layers = HIDDEN + 1
        return FieldWeights(
            arrays[:LEVELS],
            arrays[LEVELS : LEVELS + layers],
            arrays[LEVELS + layers :],
            self._start.scale,
            self._start.extent,
            self._start.pixels,
        )
