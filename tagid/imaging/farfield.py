"""Range-Doppler and polar format: the two fast classical images, for comparison and for small far objects.

Both replace the exact distance by a plane wave, which is why they blur where the object is not small beside
its distance; backprojection assumes nothing of the kind and is the better choice whenever time allows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.geometry import ImageGrid
from tagid.imaging.backprojection import upsample_at_carrier, upsampling
from tagid.imaging.memory import require_memory
from tagid.imaging.rangefilter import fast_length
from tagid.imaging.types import BasebandScans, Image
from tagid.types import Floats

_OVERSAMPLING = 2.0
"""Cells of the Cartesian spectrum per 1 / (twice the extent): keeps the replicas of the image outside it."""


def range_doppler(scans: BasebandScans, grid: ImageGrid) -> Image:
    """Range-Doppler image: in each short piece of the aperture, range bin and Doppler are the coordinates.

    In a piece about view c with line of sight u and the direction n across it, and after the distance r_v to
    the image's centre is taken out, a point p has the fixed range u.p and the phase 2k a_v n.p, a_v the angle
    from c. So f_c(p) = 1/V sum_v z_v(r_v + u.p) exp(2jk (r_v + u.p)) exp(-2jk a_v n.p) in a piece so short
    that no point moves by more than a range cell (c / 2B); the pieces are joined by their power, since their
    phases do not agree beyond the piece (Ausherman et al., IEEE Trans. AES 20, 1984).

    The scans are matched-filtered, of an aperture in or near one plane. The values are real and not negative;
    a unit point far from others gives about 1. Errors are those of `polar_format`.
    """
    distance, bearing = _polar(scans)
    centred = grid.points
    radius = grid.extent / np.sqrt(2)
    limit = min(np.deg2rad(60.0), 2 * scans.range_step_m / radius)
    values_held = scans.samples.size * upsampling(scans)
    require_memory(
        24 * values_held + 120 * len(centred),
        f"range-Doppler images of {scans.aperture.views} views, {grid.pixels} x {grid.pixels} pixels",
        "Use fewer views or pixels (`imaging.pixels`), or `imaging.method=bp`.",
    )
    power = np.zeros(len(centred))
    weight = 0
    fine, start, step = upsample_at_carrier(scans, slice(None))
    for piece in _pieces(bearing, limit):
        middle = float(bearing[piece].mean())
        along = -(centred @ np.array([np.cos(middle), np.sin(middle)]))
        across = centred @ np.array([-np.sin(middle), np.cos(middle)])
        total = np.zeros(len(centred), dtype=np.complex128)
        for v in piece:
            index = np.rint((distance[v] + along - start) / step)
            inside = (index >= 0) & (index < fine.shape[1])
            echo = np.where(inside, fine[v, np.clip(index, 0, fine.shape[1] - 1).astype(np.intp)], 0)
            total += echo * np.exp(-2j * scans.wavenumber * (bearing[v] - middle) * across)
        power += np.abs(total) ** 2 / len(piece)
        weight += len(piece)
    values = np.sqrt(power / weight).reshape(grid.pixels, grid.pixels)
    return Image(values.astype(np.complex64), grid, _facts("range-doppler", scans))


def polar_format(scans: BasebandScans, grid: ImageGrid) -> Image:
    """Polar format image: the spectrum lies on rays of the wavenumber plane, resampled to a square.

    With the distance r_v to the image's centre taken out, the spectrum of scan v at wavenumber k is the
    scene's two-dimensional spectrum at the wave vector -2k u_v, u_v the direction from the centre to the
    antenna (a plane wave). Each sample, weighted by the area |k| dk dphi that it stands for, is spread
    bilinearly onto a Cartesian spectrum, whose inverse transform is the image (Walker, IEEE Trans. AES 16,
    1980); a unit point at the centre gives about 1. The neglected curvature of the wave is a phase of k |p
    across|^2 / r: half a turn at 19 cm from the centre for a P440 at 1 m.

    Raises DataError: the antenna passes through the image's centre, so that there is no line of sight.
    UsageError: it would not fit into memory.
    """
    distance, bearing = _polar(scans)
    wavenumbers, spectrum, strength = _range_spectrum(scans, distance)
    weight = _angular_weight(bearing)[:, None] * wavenumbers[None, :]
    # Wave vectors in rad/m; exp(-2jk (r - u.p)) = exp(+j K.p) e^(-2jkr) with K = 2k u.
    kx = 2 * wavenumbers[None] * np.cos(bearing)[:, None]
    ky = 2 * wavenumbers[None] * np.sin(bearing)[:, None]
    spacing = 2 * np.pi / (_OVERSAMPLING * grid.extent)
    size = fast_length(int(np.ceil(4 * wavenumbers.max() / spacing)) + 4)
    require_memory(
        64 * size**2 + 64 * kx.size + 32 * size * grid.pixels,
        f"polar format spectra of {size} x {size} samples for {grid.extent:g} m",
        "Image a smaller square (`imaging.extent_m`), or use `imaging.method=bp`.",
    )
    cartesian = _gridded(kx / spacing, ky / spacing, spectrum * weight, size)
    # image(p) = sum over cells of F exp(-j K.p) at the pixels; the bilinear spread is divided out.
    plane = _at_pixels(cartesian, grid, spacing, size)
    values = plane / (weight * strength).sum()
    return Image(values.astype(np.complex64), grid, _facts("polar", scans))


def _facts(method: str, scans: BasebandScans) -> dict[str, object]:
    return {"method": method, "axis_distance_m": scans.aperture.axis_distance}


def _polar(scans: BasebandScans) -> tuple[Floats, Floats]:
    """Distance (views,) m from the image's centre to the antenna and its bearing (views,) rad, unwrapped."""
    offset = scans.aperture.positions
    across = np.hypot(offset[:, 0], offset[:, 1])
    if float(across.min()) < scans.range_step_m:
        raise DataError(
            "the antenna passes over the middle of the image, where this method sees no side",
            "Move the image with `centre_m=X,Y`, or use `imaging.method=bp`.",
        )
    bearing = np.unwrap(np.arctan2(offset[:, 1], offset[:, 0]))
    return np.linalg.norm(offset, axis=1), bearing


def _pieces(bearing: Floats, limit: float) -> list[NDArray[np.intp]]:
    """Views in order of bearing, cut into pieces of about equal angle no wider than `limit`."""
    order = np.argsort(bearing, kind="stable")
    span = float(bearing[order[-1]] - bearing[order[0]])
    count = max(1, int(np.ceil(span / limit)))
    edges = bearing[order[0]] + span * np.arange(1, count) / count
    parts = np.split(order, np.searchsorted(bearing[order], edges))
    return [part for part in parts if len(part)]


def _angular_weight(bearing: Floats) -> Floats:
    """(views,) angle that each view stands for: half the way to both neighbours, round the turn if closed."""
    if len(bearing) == 1:
        return np.ones(1)
    turned = bearing % (2 * np.pi)
    order = np.argsort(turned, kind="stable")
    gaps = np.diff(np.append(turned[order], turned[order[0]] + 2 * np.pi))
    # The widest gap of a partial turn belongs to nobody.
    typical = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0
    gaps = np.minimum(gaps, 2 * typical)
    out = np.empty(len(bearing))
    out[order] = (gaps + np.roll(gaps, 1)) / 2
    return out


def _range_spectrum(scans: BasebandScans, distance: Floats) -> tuple[Floats, NDArray[np.complex128], Floats]:
    """Wavenumbers (K,) rad/m, spectrum (views, K) with each view's distance taken out, |G| (K,).

    A point at distance d gives G(k) exp(-2jk (d - r_v)), G the spectrum of the response; only the band where
    the response is within 20 dB of its peak is kept.
    """
    bins = scans.samples.shape[1]
    n = fast_length(2 * bins)
    offset = 2 * np.pi * np.fft.fftfreq(n, scans.range_step_m) / 2
    spectrum = np.fft.fft(scans.samples, n, axis=1)
    response = scans.response(_folded(n) * scans.range_step_m)
    strength = np.abs(np.fft.fft(response))
    keep = strength > strength.max() / 10
    k = scans.wavenumber + offset[keep]
    start = scans.range_start_m - distance[:, None]
    # z is at baseband: its sample at R has phase exp(-2jk0 d), so k0 enters with the distance alone.
    phase = np.exp(-2j * offset[keep][None] * start) * np.exp(2j * scans.wavenumber * distance[:, None])
    return k, spectrum[:, keep] * phase, strength[keep]


def _folded(n: int) -> Floats:
    """0, 1, ..., -2, -1: sample offsets of a circular array of n."""
    return np.asarray(np.fft.fftfreq(n) * n, dtype=np.float64)


def _gridded(u: Floats, v: Floats, values: NDArray[np.complex128], size: int) -> NDArray[np.complex128]:
    """Sum of values at (u, v) cells, spread bilinearly over a periodic (size, size) array, index (v, u)."""
    left, low = np.floor(u), np.floor(v)
    out = np.zeros(size * size, dtype=np.complex128)
    for dx in (0, 1):
        for dy in (0, 1):
            share = np.abs(1 - dx - (u - left)) * np.abs(1 - dy - (v - low))
            at = ((low + dy).astype(np.int64) % size * size + (left + dx).astype(np.int64) % size).ravel()
            part = (values * share).ravel()
            out += np.bincount(at, part.real, size * size) + 1j * np.bincount(at, part.imag, size * size)
    return out.reshape(size, size)


def _at_pixels(
    spectrum: NDArray[np.complex128], grid: ImageGrid, spacing: float, size: int
) -> NDArray[np.complex128]:
    """sum_K F(K) exp(-j K.p) at every pixel, the fall-off of the bilinear spread divided out.

    Two small matrices instead of an FFT: the pixels need not lie on its grid.
    """
    axis = grid.axis
    cells = _folded(size)
    kernel = (
        np.exp(-1j * spacing * np.outer(axis, cells)) / (np.sinc(spacing * axis / (2 * np.pi)) ** 2)[:, None]
    )
    return np.asarray(kernel @ spectrum @ kernel.T)
