"""Recordings of the solved objects of `solved_objects`, made by the package's own simulator of responses.

Everything that a recording may have is drawn: the object's place, turn and height, the antenna's distance and
polarisation, a wrong axis distance, uneven rotation, an unstated pulse, coloured noise, interference, a room.
SNR is against one reflector of the tag: what the tag adds to its body, its peak per view, RMS over a turn,
times sqrt(2 / K) for K reflectors, each of which an opaque body hides for half of the turn.
"""

from __future__ import annotations

import zlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tagid.capture import Capture
from tagid.geometry import Aperture
from tagid.simulate import Acquisition, Interference, NoiseShape, Placement, Wobble, random_pulse
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import room_clutter
from tagid.simulate.render import PulseTable, render_bodies
from tagid.simulate.response import Response
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import ResponseBody
from tagid.simulate.scene import Scene, StaticReturns
from tests.benchmarks.fullwave_scenes import NAMES
from tests.benchmarks.solved_objects import OBJECTS

TURN = 2 * np.pi * np.arange(24) / 24
"""Angles at which echoes are measured for the SNR and the room."""


class Recording(NamedTuple):
    """Number of views, and SNR in dB, of a recording."""

    views: int
    snr_db: float

    @property
    def label(self) -> str:
        return f"{self.views} views, {self.snr_db:.0f} dB"


RECORDINGS = (
    *(Recording(*how) for how in ((36, 20), (36, 10), (18, 20), (18, 10), (24, 20))),
    *(Recording(*how) for how in ((72, 20), (72, 10), (12, 20), (36, 5), (36, 0))),
)
"""Recordings of every object."""


def base_of(name: str) -> str:
    """The untagged body of an object; "" for a tag alone."""
    base = name.split("_")[0]
    return base if base in OBJECTS else ""


def truth_of(name: str) -> str:
    """The built-in layout that an object carries; "" for none."""
    return NAMES.get(name.partition("_")[2], "")


@cache
def response(folder: Path, name: str) -> Response:
    return read_response(folder / f"{name}.npz")


def level(folder: Path, name: str, acquisition: Acquisition, polarisation: str) -> float:
    """Echo of one reflector of an object's tag; an untagged body has that of its first tag."""
    base = base_of(name)
    tagged = name if OBJECTS[name].places else next(n for n in OBJECTS if n != name and base_of(n) == base)
    whole = response(folder, tagged)
    tag = whole.without(response(folder, base)) if base else whole
    distance = acquisition.axis_distance_m
    antennas = Aperture.turntable(TURN, distance, 0.0).positions
    body = ResponseBody(tag, polarisation, distance)
    table = PulseTable.of(acquisition.pulse)
    plain = Acquisition(axis_distance_m=distance, window=acquisition.window)
    out = render_bodies((body,), Placement(), antennas, plain, table)
    peak = np.abs(out).max(axis=1)
    return float(np.sqrt((peak**2).mean() * 2 / max(len(OBJECTS[tagged].places), 2)))


def recorded(folder: Path, name: str, how: Recording, key: str) -> Capture:
    """A capture of an object under circumstances that are drawn for a key."""
    rng = np.random.default_rng(zlib.crc32(key.encode()))
    polarisation = "H" if rng.uniform() < 0.25 else "V"
    # Heights between the solved ones are interpolated, which costs 3 % of a body's echo.
    height = -0.1 if polarisation == "V" and rng.uniform() < 0.5 else 0.0
    offset = 0.010 * rng.uniform() * np.exp(2j * np.pi * rng.uniform())
    tone = Interference(0.0, float(rng.uniform(3.1e9, 4.8e9)), 0.5) if rng.uniform() < 0.25 else None
    colour = float(rng.uniform() * (rng.uniform() < 0.5))
    pulse = random_pulse(rng) if rng.uniform() < 0.5 else None
    acquisition = Acquisition(
        axis_distance_m=float(rng.uniform(0.8, 1.25)),
        axis_distance_error_m=float(rng.uniform(-0.02, 0.02)),
        pulse=pulse,
        noise=NoiseShape(colour, tone),
        placement=Placement((offset.real, offset.imag), float(rng.uniform(0, 2 * np.pi)), height),
        wobble=Wobble(speed=0.01 if rng.uniform() < 0.5 else 0.0),
        views=how.views,
        snr_db=how.snr_db,
    )
    rng = np.random.default_rng(int(rng.integers(2**31)))
    distance = acquisition.axis_distance_m
    unit = level(folder, name, acquisition, polarisation)
    body = ResponseBody(response(folder, name), polarisation, distance, 1 / unit)
    antennas = Aperture.turntable(TURN, distance, 0.0).positions
    out = render_bodies((body,), Placement(), antennas, acquisition, PulseTable.of(acquisition.pulse))
    room = room_clutter(rng)
    room = StaticReturns(room.ranges_m, room.amplitudes * max(1.0, float(np.abs(out).max())))
    scene = Scene(name, (body,), room=room, reference_amplitude=1.0)
    return simulate_capture(scene, acquisition, int(rng.integers(2**31)))[0]
