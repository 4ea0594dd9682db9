"""Recordings of the thin shells that were solved by the method of moments (tests/data)."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.simulate import Acquisition, Placement, Wobble, simulate_capture
from tagid.simulate.presets import room_clutter
from tagid.simulate.response import Response
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene

DATA = Path(__file__).parents[1] / "data"


@cache
def response(folder: str, name: str) -> Response:
    """A solved object."""
    return read_response(DATA / folder / f"{name}.npz")


def recorded_at(
    centre_m: tuple[float, float],
    folder: str,
    name: str,
    views: int = 36,
    snr_db: float = 20.0,
    polarisation: str = "V",
) -> BasebandScans:
    """A recording off the axis, wobbling, axis distance wrong by 8 mm, in a room."""
    rng = np.random.default_rng(len(name))
    acquisition = Acquisition(
        views=views,
        snr_db=snr_db,
        placement=Placement(centre_m, 1.0),
        wobble=Wobble(speed=0.005),
        axis_distance_error_m=0.008,
    )
    reply = response("responses", "free30_one")
    scene = response_scene(response(folder, name), acquisition, polarisation, reply, room_clutter(rng))
    capture, _ = simulate_capture(scene, acquisition, 1)
    return preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
