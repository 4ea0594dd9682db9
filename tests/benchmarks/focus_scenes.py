"""Scenes for the focus benchmark: bodies whose echoes no point model made, at two wavelengths, and paths.

Each family draws its own bodies from a seed: isolated reflectors, outlines of rough surface, smooth bodies by
physical optics, boxes, shells that show both walls, and full-wave responses. Lengths are drawn in
wavelengths, so the same family serves a P440 and a sonar in air.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tagid.capture import Capture, Pulse
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.waveform import analytic_pulse, nominal_pulse, pulse_at
from tests.benchmarks.fullwave_scenes import recorded

_FINE = 8
"""Fine range bins per range bin of the capture."""


class Radar(NamedTuple):
    """Name, band of the pulse, true distance to the rotation axis, and range bin."""

    name: str
    center_frequency_hz: float
    bandwidth_hz: float
    axis_distance_m: float
    range_step_m: float

    @property
    def wavelength_m(self) -> float:
        return SPEED_OF_LIGHT / self.center_frequency_hz


P440 = Radar("P440", 3.95e9, 1.7e9, 1.0, 0.0091488)
SONAR = Radar("17 mm", 17.4e9, 7.5e9, 0.85, 0.0020)
SONAR_WIDE = Radar("17 mm, wide", 17.4e9, 14e9, 0.85, 0.0017)
RADARS = (P440, SONAR, SONAR_WIDE)


class Body(NamedTuple):
    """Scatterers: points (n, 3), m, complex amplitudes (n,), outward unit normals in the plane (n, 2).

    A zero normal scatters to all sides; `power` is the exponent of the cosine between normal and line of
    sight, `both` what shines through from the back wall, relative amplitude.
    """

    points: np.ndarray
    amplitudes: np.ndarray
    normals: np.ndarray
    power: float = 1.0
    both: float = 0.0


def record(
    body: Body, radar: Radar, angles: np.ndarray, height_m: float, half_m: float, pulse: Pulse
) -> tuple[np.ndarray, float]:
    """(views, bins) analytic scans of a turning body, and the range of the first bin, m."""
    step = radar.range_step_m / _FINE
    bins = 2 * int(np.ceil(half_m / radar.range_step_m)) + 1
    start = radar.axis_distance_m - half_m
    n = 1 << int(np.ceil(np.log2(bins * _FINE * 1.3)))
    frequency = np.fft.fftfreq(n, 2 * step / SPEED_OF_LIGHT)
    fine_pulse = analytic_pulse(pulse, 1)
    time = (np.arange(len(fine_pulse)) - len(pulse.samples) // 2) * pulse.step
    inside = np.flatnonzero((frequency > 0) & (frequency < 2.2 * radar.center_frequency_hz))
    spectrum = np.zeros(n, dtype=np.complex128)
    spectrum[inside] = (np.exp(-2j * np.pi * np.outer(frequency[inside], time)) @ fine_pulse) * pulse.step
    spectrum *= SPEED_OF_LIGHT / (2 * step)
    rows = np.zeros((len(angles), n), dtype=np.complex128)
    for row, angle in zip(rows, angles, strict=True):
        around = radar.axis_distance_m * np.array([np.cos(-angle), np.sin(-angle)])
        sight = np.append(around, height_m) - body.points
        distance = np.linalg.norm(sight, axis=1)
        cosine = (sight[:, :2] * body.normals).sum(axis=1) / distance
        seen = np.where(cosine > 0, np.maximum(cosine, 0) ** body.power, body.both * np.abs(cosine))
        seen = np.where(np.any(body.normals, axis=1), seen, 1.0)
        values = body.amplitudes * seen * (radar.axis_distance_m / distance) ** 2
        at = (distance - start) / step
        whole = np.floor(at).astype(np.intp)
        inside_window = (whole >= 0) & (whole < n - 1)
        part = (at - whole)[inside_window]
        for shift, weight in ((0, 1 - part), (1, part)):
            index = whole[inside_window] + shift
            weighted = values[inside_window] * weight
            row.real += np.bincount(index, weighted.real, n)
            row.imag += np.bincount(index, weighted.imag, n)
    z = np.fft.ifft(np.fft.fft(rows, axis=1) * spectrum, axis=1)
    return z[:, : bins * _FINE : _FINE], start


def _closed(radius: Callable[[np.ndarray], np.ndarray], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) about `step` apart on a closed curve r(angle), and their outward normals."""
    fine = np.linspace(0, 2 * np.pi, 4001)
    curve = radius(fine) * np.exp(1j * fine)
    length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(curve)))])
    count = max(12, round(length[-1] / step))
    at = np.interp(np.arange(count) / count * length[-1], length, fine)
    eps = 1e-4
    tangent = radius(at + eps) * np.exp(1j * (at + eps)) - radius(at - eps) * np.exp(1j * (at - eps))
    normal = -1j * tangent / np.abs(tangent)
    place = radius(at) * np.exp(1j * at)
    return np.column_stack([place.real, place.imag]), np.column_stack([normal.real, normal.imag])


def _raised(xy: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """(n, 3) the points at every height."""
    return np.vstack([np.column_stack([xy, np.full(len(xy), z)]) for z in heights])


def _blob(rng: np.random.Generator, size: float) -> Callable[[np.ndarray], np.ndarray]:
    orders = np.arange(2, 7)
    a = rng.normal(0, 0.25, len(orders)) / orders
    phase = rng.uniform(0, 2 * np.pi, len(orders))
    return lambda t: (
        size * np.maximum(0.3, 1 + (a[:, None] * np.cos(np.outer(orders, t) + phase[:, None])).sum(0))
    )


def points_scene(rng: np.random.Generator, lam: float, count: int | None = None) -> Body:
    """1 to 5 reflectors that scatter to all sides, within three wavelengths of the axis."""
    count = int(rng.integers(2, 6)) if count is None else count
    xy = rng.uniform(-3, 3, (count, 2)) * lam
    amplitude = rng.uniform(0.5, 1, count) * np.exp(2j * np.pi * rng.random(count))
    return Body(np.column_stack([xy, np.zeros(count)]), amplitude, np.zeros((count, 2)))


def rough_scene(rng: np.random.Generator, lam: float) -> Body:
    """An outline of rough surface, seen where it faces the antenna, up to two wavelengths high."""
    size = rng.uniform(1.2, 5) * lam
    xy, normals = _closed(_blob(rng, size), lam / 6)
    rows = int(rng.integers(1, 5))
    points = _raised(xy, rng.uniform(-1, 1, rows) * lam)
    normals = np.tile(normals, (rows, 1))
    a = rng.standard_normal(len(points)) + 1j * rng.standard_normal(len(points))
    points[:, :2] += rng.uniform(-1.5, 1.5, 2) * lam
    return Body(points, a, normals, float(rng.choice([0.5, 1.0, 2.0])))


def smooth_scene(rng: np.random.Generator, lam: float) -> Body:
    """A smooth body by physical optics: facets an eighth of a wavelength apart, two wavelengths high."""
    size = rng.uniform(0.4, 4) * lam
    return _upright(rng, lam, *_closed(_blob(rng, size), lam / 8))


def detailed_scene(rng: np.random.Generator, lam: float) -> Body:
    """A smooth body with edges and fittings: a few bright spots on it, seen where they face the antenna."""
    smooth = smooth_scene(rng, lam)
    count = int(rng.integers(3, 9))
    chosen = rng.integers(0, len(smooth.points) // 9, count)
    total = np.sqrt(len(smooth.points))
    a = total * rng.uniform(0.1, 0.6, count) * np.exp(2j * np.pi * rng.random(count))
    points = smooth.points[chosen] * [1, 1, 0] + smooth.normals[chosen] @ np.eye(2, 3) * 0.1 * lam
    return Body(
        np.vstack([smooth.points, points]),
        np.concatenate([smooth.amplitudes, a]),
        np.vstack([smooth.normals, smooth.normals[chosen]]),
        0.5,
    )


def box_scene(rng: np.random.Generator, lam: float) -> Body:
    """A rectangular box by physical optics with its four edges as line scatterers, off the axis."""
    a, b = rng.uniform(0.7, 4, 2) * lam
    xs, ys = (np.arange(-s / 2 + lam / 16, s / 2, lam / 8) for s in (a, b))
    walls = [np.column_stack([xs, np.full(len(xs), s * b / 2)]) for s in (-1, 1)]
    walls += [np.column_stack([np.full(len(ys), s * a / 2), ys]) for s in (-1, 1)]
    outward = ([0.0, -1], [0.0, 1], [-1, 0.0], [1, 0.0])
    corners = np.array([[x, y] for x in (-a / 2, a / 2) for y in (-b / 2, b / 2)])
    xy = np.vstack([*walls, corners])
    normals = np.repeat(outward, [len(wall) for wall in walls], axis=0)
    normals = np.vstack([normals, corners / np.abs(corners) / np.sqrt(2)])
    edge = rng.uniform(0.5, 2.0)
    amplitude = np.concatenate([np.ones(len(xy) - 4), edge * np.exp(2j * np.pi * rng.random(4))])
    heights = np.arange(-1, 1.01, 0.25) * lam
    points, angle = _raised(xy, heights), rng.uniform(0, np.pi)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    points[:, :2] = points[:, :2] @ turn.T + rng.uniform(-1, 1, 2) * lam
    return Body(points, np.tile(amplitude, len(heights)), np.tile(normals, (len(heights), 1)) @ turn.T, 0.5)


def shell_scene(rng: np.random.Generator, lam: float) -> Body:
    """A thin shell, front and back wall seen, with two to four reflectors on it."""
    a, b = rng.uniform(1, 2.5, 2) * lam
    turn = rng.uniform(0, np.pi)

    def radius(t: np.ndarray) -> np.ndarray:
        return a * b / np.sqrt((b * np.cos(t - turn)) ** 2 + (a * np.sin(t - turn)) ** 2)

    xy, normals = _closed(radius, lam / 8)
    heights = np.arange(-0.5, 0.51, 0.25) * lam
    points = _raised(xy, heights)
    amplitude = np.full(len(points), 1j * rng.uniform(0.02, 0.3))
    count = int(rng.integers(2, 5))
    at = rng.uniform(0, 2 * np.pi, count)
    tags = 1.15 * np.column_stack([radius(at) * np.cos(at), radius(at) * np.sin(at), np.zeros(count)])
    points = np.vstack([points, tags])
    points[:, :2] += rng.uniform(-0.3, 0.3, 2) * lam
    return Body(
        points,
        np.concatenate([amplitude, rng.uniform(3, 6, count) * np.exp(2j * np.pi * rng.random(count))]),
        np.vstack([np.tile(normals, (len(heights), 1)), np.zeros((count, 2))]),
        1.0,
        0.6,
    )


def can_scene(rng: np.random.Generator, lam: float) -> Body:
    """One round can by physical optics, off the axis: nothing in its echo tells the distance."""
    size = rng.uniform(0.3, 1.0) * lam
    return _upright(rng, lam, *_closed(lambda t: np.full_like(t, size), lam / 16))


def _upright(rng: np.random.Generator, lam: float, xy: np.ndarray, normals: np.ndarray) -> Body:
    """An outline by physical optics, two wavelengths high, off the axis."""
    heights = np.arange(-1, 1.01, 0.25) * lam
    points = _raised(xy, heights)
    points[:, :2] += rng.uniform(-1, 1, 2) * lam
    return Body(points, np.ones(len(points), dtype=complex), np.tile(normals, (len(heights), 1)))


FAMILIES: dict[str, Callable[[np.random.Generator, float], Body]] = {
    "reflectors": points_scene,
    "one reflector": lambda rng, lam: points_scene(rng, lam, 1),
    "rough outline": rough_scene,
    "smooth body": smooth_scene,
    "body with fittings": detailed_scene,
    "box": box_scene,
    "shell with reflectors": shell_scene,
    "round can": can_scene,
}

FULL_WAVE_OBJECTS = (
    "free20_one", "free20_c90", "free20_c180", "free20_h120", "free20_lin",
    "free40_one", "free40_c90", "free40_c180", "free40_h120", "free40_lin",
    "can35", "can35_one", "can35_c90", "can35_handle", "can28", "can28_one", "can28_c180",
    "shell", "shell_h120_20", "shell_h120_40",
)  # fmt: skip


class FocusScene(NamedTuple):
    """A capture whose axis distance may be wrong, the true one, wavelength and side of the image, m."""

    capture: Capture
    true_m: float
    wavelength_m: float
    extent_m: float


def draw_error(rng: np.random.Generator, lam: float) -> float:
    """Error of the distance given: none in a third of the scenes, else up to 0.4 wavelengths."""
    return 0.0 if rng.random() < 1 / 3 else float(rng.uniform(-0.4, 0.4)) * lam


def full_wave_scene(name: str, seed: int) -> FocusScene:
    """A full-wave response, up to 8 mm off the axis, at 0.9 to 1.1 m, in a room."""
    rng = np.random.default_rng([seed, 4, FULL_WAVE_OBJECTS.index(name)])
    distance = float(rng.uniform(0.9, 1.1))
    # The arguments are drawn in this order.
    views, place = int(rng.choice([36, 72, 120, 360])), rng.uniform(-0.008, 0.008, 2)
    polarisation, snr_db = str(rng.choice(["V", "V", "H"])), float(rng.uniform(10, 30))
    how = {"views": views, "distance": distance, "pol": polarisation, "snr_db": snr_db}
    capture = recorded(name, rng, complex(*place), room=bool(rng.random() < 0.7), **how)
    given = replace(capture, axis_distance_m=distance + draw_error(rng, P440.wavelength_m))
    return FocusScene(given, distance, P440.wavelength_m, 0.5)


def draw_scene(
    family: str,
    radar: Radar,
    seed: int,
    views: int | None = None,
    turns: float = 1.0,
    higher_m: float = 0.0,
) -> FocusScene:
    """A scene of a family, with noise, a slightly uneven turn and an antenna that may stand above the
    object; the number of views is drawn, too, if None. Angles given are those of one turn, whatever turns
    the object made; the antenna stands higher than given by `higher_m`."""
    rng = np.random.default_rng([seed, 3, list(FAMILIES).index(family), RADARS.index(radar)])
    lam = radar.wavelength_m
    body = FAMILIES[family](rng, lam)
    drawn = int(rng.choice([72, 120, 360])) if radar is P440 else int(rng.choice([180, 360]))
    views = views or drawn
    angles = np.arange(views) * 2 * np.pi / views
    true = turns * angles + rng.uniform(0, 0.01) * np.sin(angles + rng.uniform(0, 6.28))
    height = float(rng.choice([0.0, 0.0, 0.05])) * radar.axis_distance_m
    reach = float(np.hypot(body.points[:, 0], body.points[:, 1]).max())
    pulse = nominal_pulse(radar.center_frequency_hz, radar.bandwidth_hz)
    z, start = record(body, radar, true, height + higher_m, reach + 4 * lam + higher_m / 4, pulse)
    peak = float(np.abs(z).max())
    snr_db = float(rng.uniform(10, 30))
    samples = z.real + peak * 10 ** (-snr_db / 20) / np.sqrt(2) * rng.standard_normal(z.shape)
    error = draw_error(rng, lam)
    capture = Capture(
        (samples / peak * 1000).astype(np.float32), start, radar.range_step_m, angles,
        axis_distance_m=radar.axis_distance_m + error, antenna_height_m=height,
        center_frequency_hz=radar.center_frequency_hz, bandwidth_hz=radar.bandwidth_hz,
    )  # fmt: skip
    extent = 2 * max(reach, lam) + lam
    return FocusScene(capture, radar.axis_distance_m, lam, extent)


PATHS = ("straight", "leakage and clutter", "bent, unsure positions", "noise alone")


def draw_rail(path: str, seed: int) -> tuple[Capture, float]:
    """300 positions past two to four reflectors 1.5 to 4 m away, and the one-way delay put in, m.

    As an antenna on a rail sees them: leakage that jitters, a beam, clutter, bent and shaky paths.
    """
    rng = np.random.default_rng([seed, 8, PATHS.index(path)])
    views, bins = 300, 800
    u = np.linspace(-1, 1, views)
    half = rng.uniform(1.0, 1.8)
    x, y, z = half * u, np.zeros(views), np.full(views, rng.choice([0.0, 0.3]))
    if path.startswith("bent"):
        y = rng.uniform(0.04, 0.12) * rng.choice([-1, 1]) * u**2
        z = z + 0.06 * np.sin(3 * u)
    antenna = np.stack([x, y, z], axis=1)
    shaky = antenna + (0.003 if path.startswith("bent") else 0.001) * rng.standard_normal((views, 3))
    delay = float(rng.uniform(-0.9, 0.9))
    count = 0 if path.startswith("noise") else int(rng.integers(2, 5))
    points = np.column_stack([rng.uniform(-1.2, 1.2, count), rng.uniform(1.5, 4.0, count), np.zeros(count)])
    strengths = rng.uniform(0.5, 1.0, count)
    if path.startswith("leakage"):
        clutter = np.column_stack([rng.uniform(*limits, 40) for limits in ((-3, 3), (0.8, 5), (0, 1))])
        points = np.vstack([points, clutter])
        strengths = np.append(strengths, rng.uniform(0, 0.15, 40))
    ranges = 0.1 + RANGE_STEP_M * np.arange(bins)
    samples = 0.1 * rng.standard_normal((views, bins))
    pulse = nominal_pulse()
    for strength, point in zip(strengths, points, strict=True):
        sight = point - shaky
        distance = np.linalg.norm(sight, axis=1)
        beam = np.maximum(sight[:, 1] / distance, 0.05) ** 2
        echo = pulse_at(pulse, 2 * (ranges - distance[:, None] - delay) / SPEED_OF_LIGHT).real
        samples += strength * (beam * (2.0 / distance))[:, None] * echo
    if path.startswith("leakage"):
        for at, size in ((0.35, 20.0), (0.5, 10.0), (0.8, 4.0)):
            jitter = 1 + 0.02 * rng.standard_normal(views)
            offset = ranges[None] - at - delay + 2e-4 * rng.standard_normal((views, 1))
            samples += size * jitter[:, None] * pulse_at(pulse, 2 * offset / SPEED_OF_LIGHT).real
    capture = Capture(samples.astype(np.float32), float(ranges[0]), RANGE_STEP_M, antenna_positions_m=antenna)
    return capture, delay
