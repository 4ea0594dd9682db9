"""Planning of a recording: echo strength, duration, and probability that the tag is named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from tagid.capture import Capture, Pulse
from tagid.constants import CENTER_FREQUENCY_HZ, SPEED_OF_LIGHT
from tagid.errors import ConfigError, UsageError
from tagid.imaging.lengths import views_needed
from tagid.motion.turntable import OVERLAP_TURNS
from tagid.planning.rates import Expected, expected
from tagid.radar.settings import RadarConfig
from tagid.recording.plan import plan_window
from tagid.signal import changing_power
from tagid.simulate.acquisition import Acquisition, RangeWindow
from tagid.simulate.budget import LinkBudget, effective_length_m, rcs_dbsm
from tagid.simulate.presets import scene_on_body
from tagid.simulate.render import PulseTable, antennas, echo_levels, render_bodies
from tagid.simulate.scatterers import Octahedron, unit_of
from tagid.simulate.source import noise_counts
from tagid.simulate.specification import BodySpec, ReflectorSpec
from tagid.tags.layouts.layout import Layout
from tagid.types import Floats

_LEVEL_VIEWS = 72
_HANDLES = 6
"""Directions of a handle over which a planned level is averaged."""
SIZES_M = (0.015, 0.020, 0.025, 0.030, 0.035, 0.040, 0.050, 0.060)
"""Reflectors considered by `--want`."""
DISTANCES_M = (0.6, 0.8, 1.0, 1.5, 2.0, 3.0)
INDICES = tuple(range(9, 16))
SMALLEST_M = 0.020
"""Reflectors of the scenes on bodies in which the rates were measured: 20 and 40 mm."""
CENTRING_M = 0.010
"""Offset from the axis that the reader allows: it rejects beyond 13 mm, and needs a margin."""
_LEAST_VIEWS = 72
"""Required views per turn when the integration is selected: the alias-free step of a helmet is 9
degrees, and half of it is a margin for lost scans."""


@dataclass(frozen=True)
class Setup:
    """A planned recording.

    Attributes:
        layout: the tag; its radius determines the effect of a body on its echoes.
        reflector, body: reflectors of the tag, and the body on which it is mounted.
        distance_m: antennas to rotation axis.
        rpm: turns per minute.
        budget: radar and antennas.
        extent_m: width of the image, which determines the range window.
        enrolled: whether the untagged body is enrolled.
        pulse: as received from a point; None for the nominal one.
    """

    layout: Layout
    reflector: ReflectorSpec
    body: BodySpec
    distance_m: float
    rpm: float
    budget: LinkBudget
    extent_m: float = 0.5
    enrolled: bool = False
    pulse: Pulse | None = None

    def __post_init__(self) -> None:
        if not 0 < self.rpm <= 1000:
            raise UsageError(f"the speed of the table is {self.rpm} rpm", "Give more than 0 and up to 1000.")
        if not 0.05 <= self.distance_m <= 20:
            raise UsageError(f"the distance is {self.distance_m:g} m", "Give 0.05 to 20, in metres.")
        if self.enrolled and self.body.kind == "none":
            raise UsageError("a bare tag has no body to enroll", "Give `body`, or omit `enrolled`.")


@dataclass(frozen=True)
class Plan:
    """The predicted performance of a setup.

    Attributes:
        setup: the requested setup.
        rcs_dbsm: of one reflector alone, of the pulse's peak.
        snr_sample_db: per reflector: peak over the noise of one sample of one scan, on its body, see
            `tagid.simulate.snr`. The SNR is `planned_snr_db`.
        snr_view_db: the same after scans are averaged into views.
        body_db: echo of the body over that of one reflector, dB; None without a body.
        margin_db: of the strongest echo below saturation, dB; negative where it clips.
        scans_per_turn, views: scans of a turn, and views that they are averaged into.
        turn_s, recording_s: seconds per turn, and of the whole recording.
        centre_m: allowed offset of the object from the axis, m.
        moved_m: offset from the axis beyond which the moving echo of the body exceeds that of a reflector,
            m; None without a body.
        rates: measured rates of the reader under such conditions.
        if_enrolled: the same if the untagged body were enrolled; None without a body, or where it is.
    """

    setup: Setup
    rcs_dbsm: float
    snr_sample_db: float
    snr_view_db: float
    body_db: float | None
    margin_db: float
    scans_per_turn: int
    views: int
    turn_s: float
    recording_s: float
    centre_m: float
    moved_m: float | None
    rates: Expected
    if_enrolled: Expected | None


def plan(setup: Setup) -> Plan:
    """Compute a plan. Raises UsageError, ConfigError for a setup that cannot be recorded."""
    scatterer = Octahedron(setup.reflector.size_m)
    length = effective_length_m(scatterer)
    free = setup.budget.snr_db(length, setup.distance_m)
    mounted_db, body_db = _on_body(setup.layout, setup.reflector, setup.body, setup.distance_m)
    sample = free + mounted_db
    config = plan_window(
        setup.distance_m, setup.extent_m, 0.0, RadarConfig(base_integration_index=setup.budget.integration)
    )
    scans = int(60 / setup.rpm / config.scan_period_s)
    if scans < 12:
        raise ConfigError(
            f"at {setup.rpm:g} rpm and integration {setup.budget.integration} a turn has {scans} scans, but "
            "12 are needed",
            "Reduce the speed or the integration.",
        )
    views = min(scans, views_needed(setup.extent_m, SPEED_OF_LIGHT / CENTER_FREQUENCY_HZ))
    view = sample + 10 * float(np.log10(scans / views))
    strongest = sample + max(0.0, body_db or 0.0)
    # Of a handle there are rates on cups only.
    body = "cup-handle" if "handle" in setup.body.parts else setup.body.kind
    return Plan(
        setup,
        rcs_dbsm(length),
        sample,
        view,
        body_db,
        setup.budget.clipping_margin_db(strongest, noise_counts(setup.budget.integration)),
        scans,
        views,
        60 / setup.rpm,
        OVERLAP_TURNS * 60 / setup.rpm,
        CENTRING_M,
        None if body_db is None else moved_distance_m(body_db),
        _rates(setup, body, views, view),
        None
        if setup.enrolled or body == "none"
        else _rates(replace(setup, enrolled=True), body, views, view),
    )


def _rates(setup: Setup, body: str, views: int, view_db: float) -> Expected:
    """The rates of the tables, with a note where the reflectors are smaller than those that were measured."""
    rates = expected(body, views, view_db, enrolled=setup.enrolled)
    if rates.note or body == "none" or setup.reflector.size_m >= SMALLEST_M:
        return rates
    size = f"{SMALLEST_M * 1e3:.0f} mm"
    note = f"measured with reflectors of {size} and more; of smaller ones beside a body, fewer are named"
    return replace(rates, note=note)


def moved_distance_m(body_db: float) -> float:
    """Offset from the axis at which the moving part of a round body's echo equals that of a reflector, m.

    The range of a body at offset d varies by d cos(angle): subtracting the mean leaves
    B |exp(-2j k d cos(angle)) - mean|, about sqrt(2) B k d (rms) for 2 k d << 1.
    """
    wavenumber = 2 * np.pi * CENTER_FREQUENCY_HZ / SPEED_OF_LIGHT
    return float(10 ** (-body_db / 20) / (np.sqrt(2) * wavenumber))


@lru_cache(maxsize=64)
def _on_body(
    layout: Layout, reflector: ReflectorSpec, body: BodySpec, distance_m: float
) -> tuple[float, float | None]:
    """Effect of the body on the strongest reflector's echo, and the body's echo relative to it, dB."""
    if body.kind == "none":
        return 0.0, None
    layouts = {layout.name: layout}
    scene = scene_on_body(layout.name, body, reflector, 0, layouts=layouts)
    acquisition, antenna = _turn(distance_m)
    table = PulseTable.of(None)
    level = echo_levels(scene, acquisition, antenna, table).reflector
    others = tuple(item for item in scene.object if item is not scene.tag)
    echo = render_bodies(others, acquisition.placement, antenna, acquisition, table)
    alone = effective_length_m(Octahedron(reflector.size_m))
    unit = alone / unit_of(Octahedron(reflector.size_m))
    mounted = 20 * float(np.log10(level / unit))
    return mounted, 20 * float(np.log10(np.abs(echo).max() / level))


def _turn(distance_m: float) -> tuple[Acquisition, Floats]:
    """A turn at a distance, and the antenna positions (views, 3), m, that its levels are computed from."""
    angles = np.arange(_LEVEL_VIEWS) * 2 * np.pi / _LEVEL_VIEWS
    window = RangeWindow.around(distance_m)
    acquisition = Acquisition(axis_distance_m=distance_m, range_law=True, window=window)
    return acquisition, antennas(angles, np.full(_LEVEL_VIEWS, distance_m), 0.0)


def planned_snr_db(setup: Setup) -> float:
    """Planned SNR of a recording, see `tagid.signal.snr_db`, dB.

    Reflectors at the same range add up, and those that a body hides add nothing in half of the views.
    """
    layout, distance = setup.layout, setup.distance_m
    acquisition, antenna = _turn(distance)
    table = PulseTable.of(setup.pulse)
    # The handle's place among the reflectors is not known: the mean over some places.
    seeds = range(_HANDLES if setup.body.parts else 1)
    power = 0.0
    for seed in seeds:
        scene = scene_on_body(layout.name, setup.body, setup.reflector, seed, layouts={layout.name: layout})
        echo = render_bodies(scene.object, acquisition.placement, antenna, acquisition, table)
        power += changing_power(echo) / len(seeds)
    scatterer = Octahedron(setup.reflector.size_m)
    alone = effective_length_m(scatterer)
    free = setup.budget.snr_db(alone, distance) + 20 * float(np.log10(unit_of(scatterer) / alone))
    return free + 10 * float(np.log10(power))


@dataclass(frozen=True)
class Wanted:
    """The least effort that reaches a rate.

    Attributes:
        plan: with the smallest reflector that reaches it at the requested distance and integration; None
            if none does.
        distance: the plan with the requested reflector at the largest distance that reaches it, or None.
        integration: the plan with the requested reflector and distance and the least integration, or None.
    """

    plan: Plan | None
    distance: Plan | None
    integration: Plan | None


def invert(setup: Setup, rate: float) -> Wanted:
    """The smallest reflector, the largest distance and the least integration that reach a rate of naming.

    Raises UsageError if the rate is not between 0 and 1.
    """
    if not 0 < rate < 1:
        raise UsageError(f"`want` is {rate:g}", "Give a rate between 0 and 1, e.g. 0.99.")
    sizes = [replace(setup, reflector=replace(setup.reflector, size_m=size)) for size in SIZES_M]
    far = [replace(setup, distance_m=distance) for distance in reversed(DISTANCES_M)]
    fast = [replace(setup, budget=replace(setup.budget, integration=index)) for index in INDICES]
    return Wanted(_first(sizes, rate), _first(far, rate), _first(fast, rate))


def _first(setups: Sequence[Setup], rate: float) -> Plan | None:
    """The first setup that reaches a rate without clipping and with enough views."""
    for setup in setups:
        try:
            candidate = plan(setup)
        except (ConfigError, UsageError):
            continue
        # Below the table's lowest SNR no rate is known.
        if candidate.rates.note:
            continue
        if (
            candidate.rates.named.value >= rate
            and candidate.margin_db > 0
            and candidate.views >= _LEAST_VIEWS
        ):
            return candidate
    return None


@dataclass(frozen=True)
class Gap:
    """Measured and planned SNR of a recording.

    Attributes:
        measured_db, planned_db: see `tagid.signal.snr_db`, dB.
        cause: likely cause of the difference; "" if it is within the budget's uncertainty.
    """

    measured_db: float
    planned_db: float
    cause: str


GAP_DB = 8.0
"""Difference within the budget's uncertainty (6 dB of its fitted loss) and that of interfering echoes."""


def gap(capture: Capture, noise: float, measured_db: float, setup: Setup) -> Gap:
    """Compare a recording with its plan, from the standard deviation of the noise of one of its samples,
    counts, and its SNR, dB, see `tagid.signal.snr_db`.
    """
    usual = noise_counts(setup.budget.integration)
    planned = planned_snr_db(setup)
    difference = measured_db - planned
    clip = capture.radar.clip_counts
    cause = ""
    if clip is not None and np.abs(capture.samples).max() >= clip:
        cause = "samples are clipped: lower the transmit gain, or increase the distance"
    elif difference < -GAP_DB:
        gain = None if capture.radar.config is None else capture.radar.config.transmit_gain
        if noise > 2 * usual:
            cause = (
                f"the noise is {20 * np.log10(noise / usual):.0f} dB above that of other recordings: "
                "another transmitter in the band, or a damaged antenna cable"
            )
        elif gain is not None and gain < setup.budget.transmit_gain:
            cause = f"the transmit gain was {gain} of 63"
        else:
            cause = (
                "the echo is weaker than planned: antennas not pointed at the object or not at its height, "
                "not both vertical, smaller reflectors, a loose cable, or a wrong antenna mode"
            )
    elif difference > GAP_DB:
        cause = (
            "more rotates than the reflectors: a body or metal that is not in the plan, "
            "or an object off the axis"
        )
    return Gap(measured_db, planned, cause)
