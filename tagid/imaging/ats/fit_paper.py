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
from scipy import sparse

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.encoding import EncodingSettings, draw_table, encoding_matrix, interpolate
from tagid.imaging.ats.forward_paper import RaySamples, sample_view, synthesize_profile
from tagid.imaging.ats.network import ReflectivityNetwork
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.memory import require_memory
from tagid.imaging.types import BasebandScans, Image

Progress = Callable[[int, int, float], None]

_FIRST_OUTPUT = 0.01
"""The last layer starts this much smaller, so that the fit starts from an empty scene."""

_KEPT_BYTES = 500_000_000
"""Samples and encoding of so many views stay in memory (a table-top view takes some 0.6 MB, one of a rail
20); larger ones are recomputed at every step."""

_CELLS_A_WAVELENGTH = 10
"""Finest cells: the reflectivity carries the ripple of the carrier, half a wavelength long, which no coarser
cell holds, however coarse the pixels."""


@dataclass(frozen=True)
class PaperSettings:
    """What the paper does not say about the optimisation, with the values chosen.

    Attributes:
        steps: optimisation steps; each takes `views_per_step` views at random ("the loss for each scan").
        views_per_step: see there.
        learning_rate: of Adam (the optimiser is not named), falling exponentially to `decay` of it.
        decay: see there.
        width: units of each of the three hidden layers (four linear layers are said, their width is not).
        l1: weight of mean |sigma| / output_scale, relative to the squared residual of a blank image, growing
            from zero over the first half of the steps; the paper speaks of scene priors without naming one,
            its closest relative has this one.
        beam_width_rad: full -3 dB width of the beam.
        ray_spacing_wavelengths: rays' distance at the middle of the scene, in wavelengths of the carrier.
        lambert_floor: least value of the Lambertian factor.
        opacity: factor of |sigma| in the transmission, see `forward_paper`.
        outside: weight of the residual outside of the pulse's band.
        output_scale: the network's unit output in 1/m; a reflector that returns the peak of the scans has
            about 80.
        levels, features, coarsest, log2_entries: of the hash encoding; its finest cell is a tenth of the
            carrier's wavelength, or a pixel where that is smaller.
        seed: of the initial weights and of the order of the views.
    """

    steps: int = 100
    views_per_step: int = 24
    learning_rate: float = 0.03
    decay: float = 0.1
    width: int = 32
    l1: float = 1.5
    beam_width_rad: float = np.pi / 2
    ray_spacing_wavelengths: float = 1 / 3
    lambert_floor: float = 0.2
    opacity: float = 0.02
    outside: float = 0.1
    output_scale: float = 100.0
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

    Minimises sum over views of |r_v(sigma(theta)) - y_v|^2 plus the sparsity term, y the real RF samples of
    the scans divided by their peak, r the model of `forward_paper`.

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
    radii: NDArray[np.float64] = start + step * np.arange(fine.shape[1], dtype=np.float64)
    keep = radii > 0
    return radii[keep][::every], np.ascontiguousarray(fine.real[:, keep][:, ::every])


def _band_limit(scans: BasebandScans, radii: NDArray[np.float64], outside: float) -> NDArray[np.complex64]:
    """(bins, bins) matrix by which profiles on `radii` keep the scans' band, the rest times `outside`."""
    n = 2 * len(radii)
    step = float(radii[1] - radii[0])
    wavenumber = np.abs(np.pi * np.fft.fftfreq(n, step))
    half = np.pi / scans.range_step_m / 2 * 0.9
    keep = np.where(np.abs(wavenumber - scans.wavenumber) < half, 1.0, outside)
    spectrum = np.fft.fft(np.eye(len(radii)), n, axis=1) * keep
    return np.fft.ifft(spectrum, axis=1)[:, : len(radii)].astype(np.complex64)


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
        wavelength = 2 * np.pi / scans.wavenumber
        ripple = int(np.ceil(grid.extent / wavelength * _CELLS_A_WAVELENGTH))
        finest = max(settings.coarsest, ripple, min(grid.pixels, 2 * ripple))
        self.encoding = EncodingSettings(
            settings.levels, settings.features, settings.coarsest, finest, settings.log2_entries
        )
        generator = torch.Generator().manual_seed(settings.seed)
        self.table = draw_table(self.encoding, generator)
        self.network = ReflectivityNetwork(self.encoding.width, settings.width, 3, generator)
        with torch.no_grad():
            self.network.weights[-1].mul_(_FIRST_OUTPUT)
            self.network.biases[-1].zero_()
        self.band = torch.from_numpy(_band_limit(scans, radii, settings.outside))
        self.kept: dict[int, tuple[RaySamples, Any]] = {}
        self.room = _KEPT_BYTES
        self._foresee()
        # sigma per metre over the pulse's length that returns the peak: the scale of the output.
        self.scale = self.settings.output_scale

    def _foresee(self) -> None:
        """Refuse a step that will not fit before it is begun."""
        s = self.settings
        spacing = 2 * np.pi / self.scans.wavenumber * s.ray_spacing_wavelengths
        rays = sample_view(self.scans.aperture, 0, self.grid, self.radii, spacing, s.beam_width_rad)
        points = int((rays.weights > 0).sum())
        views = min(s.views_per_step, len(self.samples))
        # Encoding (weights, entries, features), activations of four layers and their gradients; ray tensors.
        each = (
            points * (8 * 4 * s.levels + 8 * s.levels * s.features + 8 * 4 * s.width) + 120 * rays.depths.size
        )
        require_memory(
            views * each + _KEPT_BYTES,
            f"steps of the paper's method with {views} views of {points} points",
            "Image a smaller square (`imaging.extent_m`) or shorter scans, or use `preset=field`.",
        )

    def view(self, view: int) -> tuple[RaySamples, Any]:
        """Samples of a view, and the encoding matrix of those that lie in the scene."""
        if view in self.kept:
            return self.kept[view]
        s = self.settings
        spacing = 2 * np.pi / self.scans.wavenumber * s.ray_spacing_wavelengths
        rays = sample_view(self.scans.aperture, view, self.grid, self.radii, spacing, s.beam_width_rad)
        inside = rays.points[rays.weights > 0]
        made = (rays, encoding_matrix(inside / self.grid.extent + 0.5, self.encoding))
        size = rays.points.nbytes + rays.depths.nbytes + rays.weights.nbytes + 8 * made[1].nnz
        if size <= self.room:
            self.kept[view] = made
            self.room -= size
        return made

    def sigma(self, matrix: Any) -> Any:
        """Reflectivity (points,) complex of the points of an encoding matrix, 1/m."""
        features = interpolate(self.table, matrix, matrix.T, self.encoding)
        return self.network(features) * self.scale

    def run(self, progress: Progress | None) -> list[float]:
        """Adam; every step's squared residual relative to that of a blank image."""
        s = self.settings
        parameters = [self.table, *self.network.parameters()]
        optimiser = torch.optim.Adam(parameters, lr=s.learning_rate, betas=(0.9, 0.99), eps=1e-15)
        order = np.random.default_rng(s.seed)
        energy = float((np.abs(self.samples @ self.band.numpy()) ** 2).sum(axis=1).mean())
        count = min(s.views_per_step, len(self.samples))
        waiting: list[int] = []
        losses: list[float] = []
        for step in range(s.steps):
            if len(waiting) < count:
                waiting = [int(v) for v in order.permutation(len(self.samples))]
            views, waiting = waiting[:count], waiting[count:]
            residual, density = self.residual(views)
            residual = residual / (energy * count)
            # The prior comes in slowly: at full weight from the start the empty scene is a trap.
            loss = residual + s.l1 * min(1.0, 2 * step / s.steps) * density
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            for group in optimiser.param_groups:
                group["lr"] = s.learning_rate * s.decay ** ((step + 1) / s.steps)
            losses.append(float(residual.item()))
            if progress is not None:
                progress(step + 1, s.steps, losses[-1])
        return losses

    def residual(self, views: list[int]) -> tuple[Any, Any]:
        """Sum of squared differences over some views, and mean |sigma| of their points over the scale."""
        parts = [self.view(v) for v in views]
        everywhere = self.sigma(sparse.vstack([matrix for _, matrix in parts], format="csr"))
        profiles = []
        at = 0
        for rays, matrix in parts:
            count = matrix.shape[0] // self.encoding.levels
            inside = torch.from_numpy(rays.weights > 0)
            sigma = torch.zeros(rays.depths.shape, dtype=everywhere.dtype)
            sigma = sigma.masked_scatter(inside, everywhere[at : at + count])
            profiles.append(
                synthesize_profile(sigma, rays, self.settings.lambert_floor, self.settings.opacity)
            )
            at += count
        difference = torch.stack(profiles) - torch.from_numpy(self.samples[views])
        error = torch.view_as_real(difference @ self.band).square().sum()
        magnitude = (torch.view_as_real(everywhere).square().sum(-1) + 1e-8).sqrt()
        return error, magnitude.mean() / self.scale

    def image(self) -> NDArray[np.complex64]:
        """The network at the pixels, (pixels, pixels)."""
        matrix = encoding_matrix(self.grid.points / self.grid.extent + 0.5, self.encoding)
        with torch.no_grad():
            values = self.sigma(matrix).numpy()
        return np.asarray(values.reshape(self.grid.pixels, self.grid.pixels), dtype=np.complex64)
