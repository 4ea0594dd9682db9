"""Paths past reflectors as an antenna on a rail sees them: leakage that jitters, a beam, clutter, bent and
shaky paths."""

from __future__ import annotations

import numpy as np

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.waveform import nominal_pulse, pulse_at

PATHS = ("straight", "leakage and clutter", "bent, unsure positions", "noise alone")


def draw_rail(path: str, seed: int) -> tuple[Capture, float]:
    """300 positions past two to four reflectors 1.5 to 4 m away, and the one-way delay put in, m."""
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
        extra = 40
        clutter = np.column_stack(
            [rng.uniform(-3, 3, extra), rng.uniform(0.8, 5, extra), rng.uniform(0, 1, extra)]
        )
        points, strengths = (
            np.vstack([points, clutter]),
            np.concatenate([strengths, rng.uniform(0, 0.15, extra)]),
        )
    ranges = 0.1 + RANGE_STEP_M * np.arange(bins)
    samples = 0.1 * rng.standard_normal((views, bins))
    pulse = nominal_pulse()
    for strength, point in zip(strengths, points, strict=True):
        sight = point - shaky
        distance = np.linalg.norm(sight, axis=1)
        beam = np.maximum(sight[:, 1] / distance, 0.05) ** 2
        echo = pulse_at(pulse, 2 * (ranges - distance[:, None] - delay) / SPEED_OF_LIGHT).real
        samples += strength * (beam * (2.0 / distance) ** 1.0)[:, None] * echo
    if path.startswith("leakage"):
        for at, size in ((0.35, 20.0), (0.5, 10.0), (0.8, 4.0)):
            jitter = 1 + 0.02 * rng.standard_normal(views)
            echo = pulse_at(
                pulse,
                2 * (ranges[None] - at - delay + 2e-4 * rng.standard_normal((views, 1))) / SPEED_OF_LIGHT,
            )
            samples += size * jitter[:, None] * echo.real
    capture = Capture(samples.astype(np.float32), float(ranges[0]), RANGE_STEP_M, antenna_positions_m=antenna)
    return capture, delay
