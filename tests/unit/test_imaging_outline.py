"""A full turn of an extended body with occlusion and flashes, at defaults.

No part of the scene is a point model's: a dense closed outline of rough surface, hidden where it turns away
or lies behind another part, with a few flat facets that flash.
"""

from __future__ import annotations

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.pipeline.reconstruct import Reconstruction, reconstruct
from tagid.pipeline.settings import ImagingSettings

VACUUM = 299_792_458.0
DISTANCE, STEP, FINE, VIEWS = 49.0, 0.11, 16, 120
"""Distance to the axis, range bin (wavelengths), fine steps of a bin, views of the turn."""


def outline() -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) points on a closed curve of about 4 wavelengths radius, 0.15 apart, and outward normals."""
    t = np.arange(180) * 2 * np.pi / 180
    radius = 4 * (1 + 0.16 * np.cos(2 * t + 0.4) + 0.09 * np.cos(3 * t + 2))
    place = radius * np.exp(1j * t)
    along = np.gradient(np.concatenate([place[-2:], place, place[:2]]))[2:-2]
    normal = -1j * along / np.abs(along)
    shifted = place + 0.7 - 0.5j
    return np.column_stack([shifted.real, shifted.imag]), np.column_stack([normal.real, normal.imag])


def recording() -> tuple[np.ndarray, float]:
    """(views, bins) real samples, and the first range; all lengths in wavelengths, time in periods."""
    rng = np.random.default_rng(8)
    points, normals = outline()
    surface = rng.standard_normal(len(points)) + 1j * rng.standard_normal(len(points))
    flat = np.zeros(len(points))
    for at in (20, 77, 131):
        flat[at - 4 : at + 5] = 5
    bins = 140
    start = DISTANCE - bins / 2 * STEP
    angles = np.arange(VIEWS) * 2 * np.pi / VIEWS
    rows = np.zeros((VIEWS, bins * FINE), dtype=complex)
    for row, angle in zip(rows, angles, strict=True):
        antenna = DISTANCE * np.array([np.cos(-angle), np.sin(-angle)])
        sight = antenna - points
        distance = np.linalg.norm(sight, axis=1)
        facing = (sight * normals).sum(axis=1) / distance
        bearing = np.arctan2(*(-sight.T[::-1])) - np.arctan2(*(-antenna[::-1]))
        line = np.round(((bearing + np.pi) % (2 * np.pi) - np.pi) * DISTANCE / 0.3).astype(int)
        nearest = np.full(line.max() - line.min() + 1, np.inf)
        np.minimum.at(nearest, line - line.min(), distance)
        seen = (facing > 0) & (distance < nearest[line - line.min()] + 1)
        echo = (surface * np.maximum(facing, 0) + flat * np.maximum(facing, 0) ** 60) * seen
        np.add.at(row, np.round((distance - start) / STEP * FINE).astype(int), echo)
    # Two-way time of the fine steps, in periods.
    t = 2 * STEP / FINE * np.arange(-60 * FINE // 4, 60 * FINE // 4 + 1)
    width = np.sqrt(np.log(10)) / (np.pi * 0.43)
    pulse = np.exp(-(t**2) / (2 * width**2) + 2j * np.pi * t)
    n = 2 * rows.shape[1]
    spectrum = np.fft.fft(rows, n, axis=1) * np.fft.fft(pulse, n)
    samples = np.fft.ifft(spectrum, axis=1)[:, len(pulse) // 2 :][:, : rows.shape[1] : FINE].real
    noise = 0.02 * np.abs(samples).max() * rng.standard_normal(samples.shape)
    return samples + noise, start


def image_of(center_hz: float, speed: float) -> Reconstruction:
    """The image at defaults: the method, the focus and the priors choose for themselves."""
    lam = speed / center_hz
    samples, start = recording()
    capture = Capture(
        samples.astype(np.float32),
        start * lam,
        STEP * lam,
        angles_rad=np.arange(VIEWS) * 2 * np.pi / VIEWS,
        axis_distance_m=DISTANCE * lam,
        center_frequency_hz=center_hz,
        bandwidth_hz=0.43 * center_hz,
        wave_speed_m_s=speed,
    )
    settings = ImagingSettings(extent_m=12.5 * lam, free_pixels=True)
    return reconstruct(capture, settings)


def shown(result: Reconstruction, lam: float) -> tuple[float, float]:
    """Share of the outline with a bright pixel within half a wavelength, and of the energy within one."""
    points, _ = outline()
    power = np.abs(result.image.values.ravel()) ** 2
    place = result.image.grid.points / lam
    distance = np.linalg.norm(place[:, None] - points, axis=2)
    bright = power > power.max() * 10**-2.5
    near = (distance[bright] < 0.5).any(axis=0)
    return float(near.mean()), float(power[distance.min(axis=1) < 1].sum() / power.sum())


def test_a_dense_outline_is_drawn_and_its_axis_stays() -> None:
    lam = VACUUM / 17.4e9
    result = image_of(17.4e9, VACUUM)
    assert result.method == "ats"
    assert result.focus is not None
    assert result.image.settings["axis_distance_m"] == pytest.approx(DISTANCE * lam, abs=lam / 8)
    drawn, within = shown(result, lam)
    assert drawn > 0.8
    assert within > 0.8
    held_out = result.image.settings["held_out"]
    assert held_out["residual"] < held_out["backprojection"]
