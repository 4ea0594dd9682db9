"""Analysis through synthesis: fit a hash-encoded network until its synthesized scans equal the measured ones.

One network is trained per scene, without any training data; what it cannot know it takes from the sparsity
prior and from the smoothness of the encoding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.encoding import EncodingSettings, HashEncoding
from tagid.imaging.ats.forward import LinearOperator, synthesize
from tagid.imaging.ats.network import ReflectivityNetwork
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.sparse import column_norm
from tagid.imaging.types import BasebandScans, Image

Progress = Callable[[int, int, float], None]
"""Called after every step with (steps done, steps at most, loss)."""


@dataclass(frozen=True)
class AtsSettings:
    """Parameters of the fit.

    Attributes:
        steps: optimisation steps at most.
        learning_rate: Adam's rate for the encoding; the network gets `network_rate` of it.
        network_rate: see there.
        decay: what is left of the rates after `steps` steps (exponential decay).
        l1: weight of the sparsity prior, as a fraction of the weight at which the image would be zero.
        noise_factor: the weight is never less than this times the standard deviation of A^H noise (where the
            noise is known), and never more than half of what gives a zero image.
        views_per_step: views of one step; a capture with more is used in interleaved subsets by turns.
        width, hidden: units of a hidden layer, and hidden layers of the network.
        finest_m: edge of the finest cell of the encoding, m; never finer than the pixels.
        levels, features, coarsest, log2_entries: see `EncodingSettings`.
        tolerance: stop when the loss of the last `patience` steps is not this fraction lower than before; 0:
            never.
        patience: steps that one comparison spans.
        seed: of the initial weights; the same seed gives the same image on the same machine.
        threads: torch's threads during the fit. One is the default: the layers are so small that a second
            thread gains little where the cores are idle, and waits for its slice where they are not.
    """

    steps: int = 70
    learning_rate: float = 0.05
    network_rate: float = 1.0
    decay: float = 0.3
    l1: float = 0.03
    noise_factor: float = 1.5
    views_per_step: int = 36
    width: int = 32
    hidden: int = 2
    finest_m: float = 0.0073
    levels: int = 8
    features: int = 2
    coarsest: int = 8
    log2_entries: int = 14
    tolerance: float = 0.005
    patience: int = 20
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        least = {"steps": 1, "views_per_step": 1, "width": 1, "hidden": 0, "levels": 1, "features": 1}
        for name, low in (
            least | {"coarsest": 1, "log2_entries": 1, "patience": 1, "seed": 0, "threads": 1}
        ).items():
            if not low <= getattr(self, name) <= 10**6:
                raise UsageError(f"ATS setting {name} is {getattr(self, name)}", f"Give {low} to 1000000.")
        for name in ("learning_rate", "network_rate", "decay", "finest_m"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise UsageError(f"ATS setting {name} is {getattr(self, name)}", "Give a positive number.")
        for name in ("l1", "noise_factor", "tolerance"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise UsageError(f"ATS setting {name} is {getattr(self, name)}", "Give zero or more.")

    def encoding(self, grid: ImageGrid) -> EncodingSettings:
        """The encoding's size for a grid: the finest cell is `finest_m`, or a pixel where that is larger."""
        finest = min(grid.pixels, max(self.coarsest, round(grid.extent / self.finest_m)))
        coarsest = min(self.coarsest, finest)
        return EncodingSettings(self.levels, self.features, coarsest, finest, self.log2_entries)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What one fit works on: operators and data by subset, and what makes the loss dimensionless."""

    operators: list[LinearOperator]
    samples: list[Any]
    energy: list[float]
    output_scale: float
    l1_weight: float


def fit(
    scans: BasebandScans,
    grid: ImageGrid,
    settings: AtsSettings | None = None,
    progress: Progress | None = None,
) -> Image:
    """Reconstruct by analysis through synthesis (the paper's pipeline; see `forward` for the model).

    Minimises sum |A sigma(theta) - y|^2 / sum |y|^2 + w sum |sigma(theta)| over the parameters theta of
    encoding and network with Adam, on interleaved subsets of the views by turns.

    Args:
        scans: preprocessed scans.
        grid: pixels wanted.
        settings: parameters; the defaults are for 12 to 360 views of an object of up to a metre.
        progress: called after every step.

    Returns:
        Image with the reflectivity, in the units of the scans. Scans that are all zero give a zero image.
    """
    settings = settings or AtsSettings()
    chosen: dict[str, Any] = {"method": "ats", "engine": "torch", **asdict(settings)}
    operator = ForwardOperator(scans, grid)
    problem = _prepare(scans, operator, settings)
    if problem is None:
        empty = np.zeros((grid.pixels, grid.pixels), dtype=np.complex64)
        return Image(empty, grid, {**chosen, "steps_done": 0, "loss": 0.0})
    generator = torch.Generator().manual_seed(settings.seed)
    encoding = HashEncoding(grid.points / grid.extent + 0.5, settings.encoding(grid), generator)
    network = ReflectivityNetwork(encoding.settings.width, settings.width, settings.hidden, generator)
    threads_before = torch.get_num_threads()
    torch.set_num_threads(settings.threads)
    try:
        losses = _optimise(problem, encoding, network, settings, progress)
        with torch.no_grad():
            values = (network(encoding()) * problem.output_scale).numpy()
    finally:
        torch.set_num_threads(threads_before)
    values = values.reshape(grid.pixels, grid.pixels).astype(np.complex64)
    return Image(values, grid, {**chosen, "steps_done": len(losses), "loss": losses[-1]})


def _prepare(scans: BasebandScans, operator: Any, settings: AtsSettings) -> _Problem | None:
    """Subsets and scales; None where nothing is to be fitted (zero data, or none within the grid's reach)."""
    data: NDArray[np.complex64] = np.ascontiguousarray(scans.samples, dtype=np.complex64)
    back = operator.adjoint(data)
    energy = float(np.vdot(data, data).real)
    peak = float(np.abs(back).max(initial=0.0))
    if energy == 0 or peak == 0:
        return None
    # Least-squares amplitude of the backprojection image: the order of magnitude to start from.
    seen = operator.forward(back)
    blurred = float(np.vdot(seen, data).real / np.vdot(seen, seen).real) * peak
    floor = settings.noise_factor * scans.noise_std * column_norm(scans)
    weight = min(max(settings.l1 * peak, floor), 0.5 * peak)
    stride = max(1, round(scans.samples.shape[0] / settings.views_per_step))
    subsets = [slice(k, None, stride) for k in range(stride)]
    operators = [operator.select(s) for s in subsets] if stride > 1 else [operator]
    parts = [np.ascontiguousarray(data[s]) for s in subsets]
    return _Problem(
        operators=operators,
        samples=[torch.from_numpy(part) for part in parts],
        energy=[max(float(np.vdot(part, part).real), energy / stride * 1e-3) for part in parts],
        output_scale=3 * blurred,
        l1_weight=2 * weight / energy,
    )


def _optimise(
    problem: _Problem,
    encoding: HashEncoding,
    network: ReflectivityNetwork,
    settings: AtsSettings,
    progress: Progress | None,
) -> list[float]:
    """Adam with decaying rates until the loss stops falling or the steps are done; every step's loss."""
    groups = [
        {"params": list(encoding.parameters()), "lr": settings.learning_rate},
        {"params": list(network.parameters()), "lr": settings.learning_rate * settings.network_rate},
    ]
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.95), eps=1e-15)
    factor = settings.decay ** (1 / settings.steps)
    losses: list[float] = []
    for step in range(settings.steps):
        k = step % len(problem.operators)
        sigma = network(encoding()) * problem.output_scale
        residual = torch.view_as_real(synthesize(sigma, problem.operators[k]) - problem.samples[k])
        # The small constant keeps the gradient of |sigma| finite at zero.
        parts = torch.view_as_real(sigma)
        magnitude = (parts.square().sum(1) + 1e-12 * abs(problem.output_scale) ** 2).sqrt()
        loss = residual.square().sum() / problem.energy[k] + problem.l1_weight * magnitude.sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        for group in optimiser.param_groups:
            group["lr"] *= factor
        losses.append(float(loss.item()))
        if progress is not None:
            progress(step + 1, settings.steps, losses[-1])
        if _stalled(losses, settings):
            break
    return losses


def _stalled(losses: list[float], settings: AtsSettings) -> bool:
    """True where the last `patience` steps are on average not `tolerance` better than those before."""
    span = settings.patience
    if settings.tolerance == 0 or len(losses) < 2 * span:
        return False
    before, now = float(np.mean(losses[-2 * span : -span])), float(np.mean(losses[-span:]))
    return now > before * (1 - settings.tolerance)
