"""`--preset paper`: the published optimisation, one scene by one hash-encoded network, through the ray model.

See `forward_paper` for the model and for every choice that the paper leaves open about it; the choices about
the optimisation stand at `PaperSettings`.
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
from tagid.imaging.ats.encoding import EncodingSettings, encoding_matrix, interpolate, level_sizes
from tagid.imaging.ats.forward_paper import RaySamples, sample_view, synthesize_profile
from tagid.imaging.ats.network import ReflectivityNetwork
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.types import BasebandScans, Image

Progress = Callable[[int, int, float], None]

_KEPT_VIEWS = 72
"""Views whose samples and encoding stay in memory (some 2 MB each); more are made anew for every step."""


@dataclass(frozen=True)
class PaperSettings:
    """What the paper does not say about the optimisation, with the values chosen.

    Attributes:
        steps: optimisation steps; each takes `views_per_step` views at random ("the loss for each scan").
        views_per_step: see there.
        learning_rate: of Adam (the optimiser is not named), falling exponentially to `decay` of it.
        decay: see there.
        width: units of each of the three hidden layers (four linear layers are said, their width is not).
        l1: weight of mean |sigma|, relative to the mean square residual of a blank image; the paper speaks of
            scene priors without naming one, its closest relative has this one.
        beam_width_rad: full -3 dB width of the beam.
        ray_spacing_wavelengths: rays' distance at the middle of the scene, in wavelengths of the carrier.
        lambert_floor: least value of the Lambertian factor.
        levels, features, coarsest, log2_entries: of the hash encoding; its finest cell is a pixel.
        seed: of the initial weights and of the order of the views.
    """

    steps: int = 250
    views_per_step: int = 4
    learning_rate: float = 0.02
    decay: float = 0.1
    width: int = 32
    l1: float = 0.02
    beam_width_rad: float = np.pi / 2
    ray_spacing_wavelengths: float = 1 / 3
    lambert_floor: float = 0.2
    levels: int = 8
    features: int = 2
    coarsest: int = 8
    log2_entries: int = 14
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "views_per_step", "width", "levels", "features", "coarsest"):
            if not 1 <= getattr(self, name) <= 10**6:
                raise UsageError(f"paper setting {name} is {getattr(self, name)}", "Give 1 to 1000000.")
        if not (0 < self.learning_rate < 10 and 0 < self.decay <= 1 and 0 <= self.l1 < 100):
            raise UsageError("paper settings: learning rate, decay or l1 makes no sense")


def fit_paper(
    scans: BasebandScans,
    grid: ImageGrid,
    settings: PaperSettings | None = None,
    progress: Progress | None = None,
) -> Image:
    """Reconstruct by the paper's analysis through synthesis.

    Minimises sum over views of |r_v(sigma(theta)) - y_v|^2 plus the sparsity term, y the real RF samples of the
    scans divided by their peak, r the model of `forward_paper`.

    Args:
        scans: preprocessed without matched filter.
        grid: pixels wanted, about the origin.
        settings: see `PaperSettings`.
        progress: called after every step with (steps done, steps, loss).

    Returns:
        Image of sigma (1/m). Its settings hold the losses of the first and the last tenth of the steps,
        relative to a blank image. Scans that are all zero give a zero image.
    """
    settings = settings or PaperSettings()
    facts: dict[str, Any] = {"method": "ats", "preset": "paper", "engine": "torch", **asdict(settings)}
    facts["axis_distance_m"] = scans.aperture.axis_distance
    radii, samples = _radio_frequency(scans)
    peak = float(np.abs(samples).max(initial=0.0))
    if peak == 0:
        empty = np.zeros((grid.pixels, grid.pixels), dtype=np.complex64)
        return Image(empty, grid, {**facts, "steps_done": 0})
    fit = _Fit(scans, grid, settings, radii, samples / peak)
    losses = fit.run(progress)
    tenth = max(1, len(losses) // 10)
    facts |= {"steps_done": len(losses), "loss_first": float(np.mean(losses[:tenth]))}
    facts["loss"] = float(np.mean(losses[-tenth:]))
    return Image(fit.image(), grid, facts)


def _radio_frequency(scans: BasebandScans) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Radii (bins,) m and real RF samples (views, bins) at four samples a period of the carrier or more."""
    fine, start, step = upsample_at_carrier(scans, slice(None))
    every = max(1, int(np.pi / scans.wavenumber / 4 / step))
    radii = start + step * np.arange(fine.shape[1])
    keep = radii > 0
    return radii[keep][::every], np.ascontiguousarray(fine.real[:, keep][:, ::every])


class _Fit:
    """One scene's network, its data, and the samples of the views."""

    def __init__(
        self,
        scans: BasebandScans,
        grid: ImageGrid,
        settings: PaperSettings,
        radii: NDArray[np.float64],
        samples: NDArray[np.float32],
    ) -> None:
        self.scans, self.grid, self.settings = scans, grid, settings
        self.radii, self.samples = radii, samples
        finest = max(settings.coarsest, grid.pixels)
        self.encoding = EncodingSettings(
            settings.levels, settings.features, settings.coarsest, finest, settings.log2_entries
        )
        generator = torch.Generator().manual_seed(settings.seed)
        drawn = torch.rand(sum(level_sizes(self.encoding)), settings.features, generator=generator)
        self.table = torch.nn.Parameter((drawn * 2 - 1) * 1e-2)
        self.network = ReflectivityNetwork(self.encoding.width, settings.width, 3, generator)
        self.kept: dict[int, tuple[RaySamples, Any, Any]] = {}
        # sigma per metre over the pulse's length that returns the peak: the scale of the output.
        self.scale = 1 / (scans.range_step_m * 2)

    def view(self, view: int) -> tuple[RaySamples, Any, Any]:
        """Samples of a view with their encoding matrix and its transpose."""
        if view in self.kept:
            return self.kept[view]
        s = self.settings
        spacing = 2 * np.pi / self.scans.wavenumber * s.ray_spacing_wavelengths
        rays = sample_view(self.scans.aperture, view, self.grid, self.radii, spacing, s.beam_width_rad)
        unit = rays.points.reshape(-1, 2) / self.grid.extent + 0.5
        matrix = encoding_matrix(unit, self.encoding)
        made = (rays, matrix, matrix.T.tocsr())
        if len(self.kept) < _KEPT_VIEWS:
            self.kept[view] = made
        return made

    def sigma(self, matrix: Any, transposed: Any) -> Any:
        """Reflectivity (points,) complex of the points of an encoding matrix, 1/m."""
        return self.network(interpolate(self.table, matrix, transposed, self.encoding)) * self.scale

    def run(self, progress: Progress | None) -> list[float]:
        """Adam; every step's squared residual relative to that of a blank image."""
        s = self.settings
        parameters = [self.table, *self.network.parameters()]
        optimiser = torch.optim.Adam(parameters, lr=s.learning_rate, betas=(0.9, 0.99), eps=1e-15)
        order = np.random.default_rng(s.seed)
        energy = float((self.samples**2).sum(axis=1).mean())
        count = min(s.views_per_step, len(self.samples))
        waiting: list[int] = []
        losses: list[float] = []
        for step in range(s.steps):
            if len(waiting) < count:
                waiting = [int(v) for v in order.permutation(len(self.samples))]
            views, waiting = waiting[:count], waiting[count:]
            residual = torch.zeros(())
            density = torch.zeros(())
            for v in views:
                rays, matrix, transposed = self.view(v)
                sigma = self.sigma(matrix, transposed).view(*rays.depths.shape)
                profile = synthesize_profile(sigma, rays, s.lambert_floor)
                measured = torch.from_numpy(self.samples[v])
                error = torch.view_as_real(profile - measured)
                residual = residual + error.square().sum() / (energy * count)
                parts = torch.view_as_real(sigma)
                density = density + (parts.square().sum(-1) + 1e-8).sqrt().mean() / (self.scale * count)
            loss = residual + s.l1 * density
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            for group in optimiser.param_groups:
                group["lr"] = s.learning_rate * s.decay ** ((step + 1) / s.steps)
            losses.append(float(residual.item()))
            if progress is not None:
                progress(step + 1, s.steps, losses[-1])
        return losses

    def image(self) -> NDArray[np.complex64]:
        """The network at the pixels, (pixels, pixels)."""
        matrix = encoding_matrix(self.grid.points / self.grid.extent + 0.5, self.encoding)
        with torch.no_grad():
            values = self.sigma(matrix, matrix.T.tocsr()).numpy()
        return np.asarray(values.reshape(self.grid.pixels, self.grid.pixels), dtype=np.complex64)
