"""`--preset paper`: the published optimisation, one scene by one hash-encoded network, through the ray model.

The model is `sample_view` and `synthesize_profile`; the choices that the paper leaves open about the
optimisation stand at `PaperSettings`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse

from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.ats.problem import TABLE_INIT
from tagid.imaging.ats.settings import StepProgress
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.memory import require_memory
from tagid.imaging.types import BasebandScans, Image
from tagid.types import Floats

_HASH_PRIME = 2_654_435_761
"""Second prime of the spatial hash (Müller et al., eq. 4; the first one is 1)."""


@dataclass(frozen=True)
class EncodingSettings:
    """Size of the encoding: levels with so many features, from `coarsest` to `finest` cells along a side of
    the unit square; one with more than 2**log2_entries vertices is hashed into that many entries."""

    levels: int = 8
    features: int = 2
    coarsest: int = 8
    finest: int = 96
    log2_entries: int = 14

    @property
    def width(self) -> int:
        """Features of a point over all levels."""
        return self.levels * self.features

    def resolutions(self) -> list[int]:
        """Cells a side of every level (floor of a geometric series, Müller et al., eq. 2)."""
        series = np.geomspace(self.coarsest, self.finest, self.levels)
        return [int(cells) for cells in np.floor(series + 1e-9)]


def vertex_entry(
    vertices: NDArray[np.int64], resolution: int, settings: EncodingSettings
) -> NDArray[np.int64]:
    """(n,) table entries of vertices (n, 2), 0..resolution, within their level: row by row where it is dense,
    by the exclusive or of multiples where it is hashed."""
    side = resolution + 1
    if side * side <= 2**settings.log2_entries:
        return np.asarray(vertices[:, 0] * side + vertices[:, 1])
    hashed = vertices[:, 0].astype(np.uint64) ^ (vertices[:, 1].astype(np.uint64) * np.uint64(_HASH_PRIME))
    return np.asarray(hashed % np.uint64(2**settings.log2_entries)).astype(np.int64)


def level_sizes(settings: EncodingSettings) -> list[int]:
    """Table entries of every level: its vertices where they fit, 2**log2_entries otherwise."""
    return [min((cells + 1) ** 2, 2**settings.log2_entries) for cells in settings.resolutions()]


def encoding_matrix(points: NDArray[np.floating], settings: EncodingSettings) -> sparse.csr_array[np.float32]:
    """Bilinear interpolation on every level as one matrix, (P * levels, entries) CSR float32.

    Row p * levels + l holds the four corner weights of point p, of (P, 2) in the unit square, on level l.
    """
    count, levels = len(points), settings.levels
    entries = np.empty((count, levels, 4), dtype=np.int64)
    weights = np.empty((count, levels, 4), dtype=np.float32)
    offset = 0
    for level, (cells, size) in enumerate(zip(settings.resolutions(), level_sizes(settings), strict=True)):
        position = np.clip(points, 0.0, 1.0) * cells
        corner = np.minimum(position.astype(np.int64), cells - 1)
        part = position - corner
        for i, (dx, dy) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            entries[:, level, i] = offset + vertex_entry(corner + np.array([dx, dy]), cells, settings)
            weights[:, level, i] = np.prod(np.abs(np.array([1 - dx, 1 - dy]) - part), axis=1)
        offset += size
    starts = np.arange(0, 4 * count * levels + 1, 4, dtype=np.int32)
    parts = (weights.ravel(), entries.astype(np.int32).ravel(), starts)
    return sparse.csr_array(parts, shape=(count * levels, offset))


class _SparseProduct(torch.autograd.Function):  # type: ignore[misc]
    """y = S x with dL/dx = S^T dL/dy; scipy's product repeats bit for bit, a scatter-add need not."""

    @staticmethod
    def forward(ctx: Any, x: Any, matrix: Any, transposed: Any) -> Any:
        ctx.transposed = transposed
        return torch.from_numpy(matrix @ x.detach().numpy())

    @staticmethod
    def backward(ctx: Any, grad: Any) -> Any:
        return torch.from_numpy(ctx.transposed @ grad.contiguous().numpy()), None, None


def interpolate(table: Any, matrix: Any, transposed: Any, settings: EncodingSettings) -> Any:
    """(P, levels * features) features of the points of an `encoding_matrix`, differentiable by the table."""
    return _SparseProduct.apply(table, matrix, transposed).view(-1, settings.width)


LEAST_GRADIENT = 1000.0
"""Gradient of |sigma|, 1/m^2, of which half counts as a surface; a reflector has 80 / m within 1 cm."""


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Where the rays of one view meet its spheres.

    Attributes:
        points: (rays, bins, 2) m, in the object's plane.
        depths: (rays, bins) l of eq. 4, m along the ray; 0 if a sphere does not reach the plane.
        weights: (rays, bins) beam directivity times arc length, m; 0 if there is no point of the scene.
        ray_step_rad: angle between neighbouring rays.
    """

    points: Floats
    depths: Floats
    weights: Floats
    ray_step_rad: float


def positive_root(start: Floats, directions: Floats, radii: Floats) -> Floats:
    """(rays, bins) depths l at which rays start + l d meet spheres of radii R (bins,), m, about the origin
    (eq. 5).

    a = d.d, b = 2 x.d, c = x.x - R^2, l = (-b + sqrt(b^2 - 4ac)) / 2a, with start (3,) relative to the
    centre, m, and directions (rays, 3) of any length; nan where a ray misses a sphere or the root is not
    positive.
    """
    a = (directions**2).sum(axis=1)[:, None]
    b = 2 * (directions @ start)[:, None]
    c = float(start @ start) - radii[None] ** 2
    inside = b**2 - 4 * a * c
    root = (-b + np.sqrt(np.maximum(inside, 0))) / (2 * a)
    return np.where((inside >= 0) & (root > 0), root, np.nan)


def sample_view(
    aperture: Aperture, view: int, grid: ImageGrid, radii: Floats, ray_spacing_m: float, beam_width_rad: float
) -> RaySamples:
    """The points of one view: a fan of rays towards the scene, cut by spheres of radii (bins,), m."""
    antenna = aperture.positions[view]
    foot, height = antenna[:2], float(antenna[2])
    distance = max(float(np.hypot(*foot)), 1e-6)
    reach = grid.extent / np.sqrt(2)
    half = float(np.arcsin(min(1.0, reach / distance)))
    half = min(half, beam_width_rad / 2)
    rays = max(3, int(np.ceil(2 * half * distance / ray_spacing_m)))
    theta = (np.arange(rays) + 0.5) / rays * 2 * half - half
    bearing = np.arctan2(-foot[1], -foot[0]) + theta
    directions = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(rays)], axis=1)
    depths = np.nan_to_num(positive_root(np.array([0.0, 0.0, -height]), directions, radii))
    points = foot + depths[:, :, None] * directions[:, None, :2]
    inside = (np.abs(points) < grid.extent / 2).all(axis=2) & (depths > 0)
    step = 2 * half / rays
    beam = 2.0 ** -((2 * theta / beam_width_rad) ** 2)
    return RaySamples(points, depths, inside * beam[:, None] * depths * step, step)


def synthesize_profile(sigma: Any, samples: RaySamples, lambert_floor: float, opacity: float) -> Any:
    """r (bins,) complex of reflectivities sigma (rays, bins) complex at the points of one view.

    r_i = sum_j w_ij T_ij^(2 opacity) sigma_ij max(floor, |n_ij . d_j|), differentiable by sigma.
    """
    depths = torch.from_numpy(samples.depths.astype(np.float32))
    weights = torch.from_numpy(samples.weights.astype(np.float32))
    parts = torch.view_as_real(sigma * (weights > 0))
    magnitude = (parts.square().sum(-1) + 1e-8).sqrt()
    length = torch.diff(depths, dim=1, append=depths[:, -1:]).clamp_min(0)
    passed = torch.cumsum(magnitude * length, dim=1) - magnitude * length
    transmission = torch.exp(-2 * opacity * passed)
    lambert = _facing(magnitude, depths, samples.ray_step_rad).clamp_min(lambert_floor)
    return (weights * transmission * lambert * sigma).sum(dim=0)


def _facing(magnitude: Any, depths: Any, ray_step_rad: float) -> Any:
    """|n . d| (rays, bins): the share of the gradient of |sigma| that lies along the ray."""
    step = torch.diff(depths, dim=1).clamp_min(1e-4)
    inner = torch.diff(magnitude, dim=1) / step
    outward = ((torch.nn.functional.pad(inner, (1, 0)) + torch.nn.functional.pad(inner, (0, 1))) / 2).abs()
    sideways = torch.diff(magnitude, dim=0)
    across = torch.nn.functional.pad(sideways, (0, 0, 1, 0)) + torch.nn.functional.pad(sideways, (0, 0, 0, 1))
    across = across / 2 / (depths * ray_step_rad).clamp_min(1e-4)
    return outward / (outward.square() + across.square() + LEAST_GRADIENT**2).sqrt()


LEAK = 0.01
"""Slope of the hidden units below zero: with none, noise at times leaves every unit dark for good."""


class ReflectivityNetwork(torch.nn.Module):  # type: ignore[misc]
    """Linear layers, `hidden` and the output, with leaky ReLU between them; outputs are real and imaginary
    part. Weights are uniform with variance 1 / (3 fan-in), drawn from the given generator alone."""

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
        learning_rate: of Adam (the optimiser is not named), falling exponentially to `decay` of it.
        width: units of each of the three hidden layers (four linear layers are said, their width is not).
        l1: weight of mean |sigma| / output_scale, relative to the squared residual of a blank image, growing
            from zero over the first half of the steps; the paper speaks of scene priors without naming one,
            its closest relative has this one.
        beam_width_rad: full -3 dB width of the beam.
        ray_spacing_wavelengths: rays' distance at the middle of the scene, in wavelengths of the carrier.
        lambert_floor: least value of the Lambertian factor.
        opacity: factor of |sigma| in the transmission, see `synthesize_profile`.
        stopband: weight of the residual outside of the pulse's band.
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
    stopband: float = 0.1
    output_scale: float = 100.0
    levels: int = 8
    features: int = 2
    coarsest: int = 8
    log2_entries: int = 14
    seed: int = 0


def fit_paper(
    scans: BasebandScans,
    grid: ImageGrid,
    settings: PaperSettings | None = None,
    progress: StepProgress | None = None,
) -> Image:
    """Reconstruct by the paper's analysis through synthesis, from scans without matched filter.

    Minimises sum over views of |r_v(sigma(theta)) - y_v|^2 plus the sparsity term, y the real RF samples of
    the scans divided by their peak, r the model of `synthesize_profile`. `progress` is called after every
    step with (steps done, steps, loss).

    Returns the image of sigma (1/m). Its settings hold the losses of the first and the last tenth of the
    steps, relative to a blank image. Scans that are all zero give a zero image.
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


def _band_limit(scans: BasebandScans, radii: NDArray[np.float64], stopband: float) -> NDArray[np.complex64]:
    """(bins, bins) matrix by which profiles on `radii` keep the scans' band, the rest times `stopband`."""
    n = 2 * len(radii)
    step = float(radii[1] - radii[0])
    wavenumber = np.abs(np.pi * np.fft.fftfreq(n, step))
    half = np.pi / scans.range_step_m / 2 * 0.9
    keep = np.where(np.abs(wavenumber - scans.wavenumber) < half, 1.0, stopband)
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
        drawn = torch.rand(sum(level_sizes(self.encoding)), settings.features, generator=generator)
        self.table = torch.nn.Parameter((drawn * 2 - 1) * TABLE_INIT)
        self.network = ReflectivityNetwork(self.encoding.width, settings.width, 3, generator)
        with torch.no_grad():
            self.network.weights[-1].mul_(_FIRST_OUTPUT)
            self.network.biases[-1].zero_()
        self.band = torch.from_numpy(_band_limit(scans, radii, settings.stopband))
        self.kept: dict[int, tuple[RaySamples, Any]] = {}
        self.room = _KEPT_BYTES
        self.scale = settings.output_scale
        self._foresee()

    def _foresee(self) -> None:
        """Refuse a step that will not fit before it is begun."""
        s, rays = self.settings, self._rays(0)
        points = int((rays.weights > 0).sum())
        views = min(s.views_per_step, len(self.samples))
        # Encoding (weights, entries, features), activations of four layers and their gradients; ray tensors.
        predictions = (
            points * (8 * 4 * s.levels + 8 * s.levels * s.features + 8 * 4 * s.width) + 120 * rays.depths.size
        )
        require_memory(
            views * predictions + _KEPT_BYTES,
            f"steps of the paper's method with {views} views of {points} points",
            "Image a smaller square (`imaging.extent_m`) or shorter scans, or use `preset=field`.",
        )

    def _rays(self, view: int) -> RaySamples:
        s = self.settings
        spacing = 2 * np.pi / self.scans.wavenumber * s.ray_spacing_wavelengths
        return sample_view(self.scans.aperture, view, self.grid, self.radii, spacing, s.beam_width_rad)

    def view(self, view: int) -> tuple[RaySamples, Any]:
        """Samples of a view, and the encoding matrix of those that lie in the scene."""
        if view in self.kept:
            return self.kept[view]
        rays = self._rays(view)
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

    def run(self, progress: StepProgress | None) -> list[float]:
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
