"""Layouts of one plan that differ in their heights, and recordings of them from several antenna heights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tagid.capture import Capture
from tagid.pipeline.join import join
from tagid.tags.layouts.layout import Layout
from tests.unit.imaging_scenes import record, turn

PLAN = np.array([[0.1, 0.0], [-0.02, 0.08], [-0.05, -0.09]])
UP = Layout("up", PLAN, heights=np.array([0.0, 0.06, 0.0]))
DOWN = Layout("down", PLAN, heights=np.array([0.0, -0.06, 0.0]))
OTHER = Layout("other", PLAN, heights=np.array([0.06, 0.0, 0.0]))
FLAT = Layout("flat", PLAN)


def scan(layout: Layout, heights: tuple[float, ...], raised: float = 0.0, views: int = 36) -> Capture:
    """A turn at 20 dB from each height, of the layout rotated by 40 degrees, with a room at each height."""
    c, s = np.cos(0.7), np.sin(0.7)
    plane = layout.positions @ np.array([[c, s], [-s, c]]) + np.array([0.004, -0.002])
    points = np.column_stack([plane, np.asarray(layout.heights) + raised])
    parts = []
    for number, height in enumerate(heights):
        recorded = record(points, [1, 1, 1], turn(views, 1.0, height), start_m=0.5, noise=0.1, seed=number)
        room = 2 * np.sin(np.arange(recorded.bins) * (0.5 + 0.1 * number))
        parts.append(replace(recorded, samples=(recorded.samples + room).astype(np.float32)))
    return join(parts) if len(parts) > 1 else parts[0]
