"""A rig as the emulator imitates it: one of random but realistic faults of its own, or a commissioned one.

`realistic?seed=N` draws what the first hour with hardware meets: a measured pulse that rings, a cable delay
that drifts with the temperature, a clock that is off, an axis that is not where the tape says, a table that
wobbles, antennas above the object's plane, a person who stands in the room, lost packets. `fault=NAME` plants
a mistake on top.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Pulse
from tagid.errors import UsageError
from tagid.query import MAX_SEED
from tagid.radar.emulation.firmware import Identity
from tagid.radar.settings import RadarConfig
from tagid.radar.urls import RadarOptions
from tagid.rig import RigProfile, read_profile
from tagid.simulate.acquisition import Acquisition, Placement, Wobble
from tagid.simulate.budget import LinkBudget
from tagid.simulate.noise import Interference, NoiseShape
from tagid.simulate.objects import Variation, object_scene
from tagid.simulate.presets import room_clutter
from tagid.simulate.scatterers import Octahedron, unit_of
from tagid.simulate.scene import Scene, StaticReturns
from tagid.simulate.snr import noise_std_for
from tagid.simulate.source import Stop, TurningScene
from tagid.simulate.specification import BodySpec, ReflectorSpec
from tagid.tags.layouts.layout import Layout

REALISTIC: Final = "realistic"
TARGET: Final = "target"
"""Scene of the reference target, an octahedron of 40 mm on the rotation axis."""
NOMINAL_DISTANCE_M: Final = 1.0
"""Distance to the axis that the builder of a realistic rig intended."""
_REFLECTOR: Final = ReflectorSpec("octahedron", 0.040)
_STRENGTH_DB: Final = 1.0
"""Spread of reflectors made by hand."""
_WARM_UP_S: Final = 600.0
_WARM_UP_C: Final = 8.0
_PERSON: Final = (3.2, 0.15, 4.0, 2.0)
"""Mean range and amplitude of the motion, m, its period, s, and the echo of the operator
over that of a reflector."""
_WALKER: Final = (1.0, 0.35, 3.0, 3.0)


class Fault(StrEnum):
    """A mistake planted in a rig."""

    CABLE = "cable"
    LOOSE_ANTENNA = "loose-antenna"
    POLARISATION = "polarisation"
    GAIN = "gain"
    OTHER_RADAR = "other-radar"
    MICROWAVE = "microwave"
    DIRECTION = "direction"
    SLIP = "slip"
    AXIS = "axis"
    MISSING_REFLECTOR = "missing-reflector"
    MIRRORED_CARD = "mirrored-card"
    PERSON = "person"
    NEAR = "near"


@dataclass(frozen=True, eq=False)
class EmulatedRig:
    """The true values of an emulated rig.

    Attributes:
        seed: of the room, and of what is random between rigs.
        pulse: as received from a point.
        cable_delay_ps: two-way, at the end of the warm-up, ps.
        drift_ps_c: change of the delay with the temperature, ps per degree.
        clock_ppm: error of the radar's clock.
        axis_distance_m, antenna_height_m: of the antennas, m.
        tilt_rad: of the antennas against each other.
        gain_db: received echo over that of the link budget.
        period_s: of a turn, s.
        speed_variation: RMS, relative.
        direction: +1 counter-clockwise.
        loss: share of lost packets.
        fault: planted mistake, or None.
        strength_db: spread of the reflectors.
        person: whether somebody stands in the room.
    """

    seed: int
    pulse: Pulse
    cable_delay_ps: float
    drift_ps_c: float
    clock_ppm: float
    axis_distance_m: float
    antenna_height_m: float
    tilt_rad: float
    gain_db: float
    period_s: float
    speed_variation: float
    direction: int = 1
    loss: float = 0.0
    fault: Fault | None = None
    strength_db: float = _STRENGTH_DB
    person: bool = True

    @classmethod
    def random(cls, seed: int, fault: Fault | None = None) -> EmulatedRig:
        """A realistic rig; the fault changes nothing else of it."""
        rng = np.random.default_rng([seed, 49])
        pulses = measured_pulses()
        rig = cls(
            seed,
            pulses[int(rng.integers(len(pulses)))],
            float(rng.uniform(10_000, 13_000)),
            float(rng.uniform(-0.5, 0.5)),
            float(rng.uniform(-5, 5)),
            NOMINAL_DISTANCE_M + float(rng.uniform(-0.010, 0.010)),
            float(rng.uniform(0.03, 0.07)),
            math.radians(2),
            float(rng.uniform(-1.5, 1.5)),
            float(rng.uniform(24, 36)),
            0.015,
            loss=0.002,
        )
        changes: dict[Fault | None, dict[str, Any]] = {
            Fault.CABLE: {"cable_delay_ps": rig.cable_delay_ps + 5_000},
            Fault.LOOSE_ANTENNA: {"gain_db": rig.gain_db - 10},
            Fault.POLARISATION: {"gain_db": rig.gain_db - 22},
            Fault.DIRECTION: {"direction": -1},
            Fault.AXIS: {"axis_distance_m": rig.axis_distance_m + 0.05},
            Fault.NEAR: {"axis_distance_m": rig.axis_distance_m - 0.65},
        }
        return replace(rig, fault=fault, **changes.get(fault, {}))

    @classmethod
    def of(cls, profile: RigProfile) -> EmulatedRig:
        """The rig of a profile, without what a profile does not tell."""
        return cls(
            0,
            profile.pulse,
            profile.path_delay_ps.value,
            0.0,
            0.0,
            profile.axis_distance_m.value,
            profile.antenna_height_m.value,
            0.0,
            profile.system_gain_db.value,
            profile.period_s.value,
            max(profile.speed_variation.value, 0.0),
            profile.direction,
            strength_db=0.0,
            person=False,
        )

    @property
    def identity(self) -> Identity:
        """What the radar reports of itself."""
        return Identity(serial=0x440 + self.seed % 1000, clock_ppm=self.clock_ppm)

    def scene(self, name: str, layouts: Mapping[str, Layout], body: BodySpec = BodySpec()) -> Scene:
        """A scene on this rig: empty, target, or a layout on a body. Raises UsageError for another name."""
        room = room_clutter(np.random.default_rng([self.seed, 1]))
        if self.fault is Fault.GAIN:
            room = StaticReturns(room.ranges_m, room.amplitudes * 40)
        if name == "empty":
            return Scene(name, room=room, reference_amplitude=1.0, description={"seed": self.seed})
        if name == TARGET:
            positions = np.zeros((1, 2))
        elif name in layouts:
            positions = layouts[name].positions
        else:
            raise UsageError(
                f"a rig shows no scene {name[:80]!r}", f"Use empty, {TARGET}, {', '.join(sorted(layouts))}."
            )
        if self.fault is Fault.MISSING_REFLECTOR and name != TARGET:
            positions = positions[1:]
        if self.fault is Fault.MIRRORED_CARD and name != TARGET:
            positions = positions * np.array([1.0, -1.0])
        rng = np.random.default_rng([self.seed, 2])
        change = Variation(strength_db=self.strength_db)
        return object_scene(name, positions, body, _REFLECTOR, rng=rng, room=room, variation=change,
                            layout=name, seed=self.seed)  # fmt: skip

    def acquisition(self, placement: Placement) -> Acquisition:
        """How it records; the noise is that of the link budget."""
        slant = math.hypot(self.axis_distance_m, self.antenna_height_m)
        loss = LinkBudget.loss_db - self.gain_db - 40 * math.log10(math.cos(self.tilt_rad))
        snr = LinkBudget(loss_db=loss).snr_db(unit_of(Octahedron(_REFLECTOR.size_m)), slant)
        tone = Interference(15.0, 2.45e9, 0.5) if self.fault is Fault.MICROWAVE else None
        return Acquisition(
            axis_distance_m=self.axis_distance_m,
            antenna_height_m=self.antenna_height_m,
            pulse=self.pulse,
            noise_std=noise_std_for(snr, 1.0),
            noise=NoiseShape(interference=tone),
            placement=placement,
            wobble=Wobble(speed=self.speed_variation),
            direction=self.direction,
            range_law=True,
        )


class RigScene(TurningScene):
    """A scene of `EmulatedRig.scene` on an emulated rig: its delay drifts, and somebody else is in the room.
    The seed is that of the noise.
    """

    def __init__(self, scene: Scene, rig: EmulatedRig, placement: Placement, seed: int) -> None:
        slips = Stop(0.75, 0.08 * rig.period_s) if rig.fault is Fault.SLIP else None
        self._rig = rig
        super().__init__(scene, 60 / rig.period_s, rig.seed, rig.acquisition(placement), stop=slips)
        self.seed = rig.seed * 1_000_003 + seed

    def clean(self, time_s: float, config: RadarConfig) -> NDArray[np.float64]:
        """As of `TurningScene`, with drift, persons and other transmitters."""
        rig = self._rig
        cold = -_WARM_UP_C * math.exp(-time_s / _WARM_UP_S)
        # To a tenth of a picosecond, so that the room is not drawn anew for every scan.
        self.cable_delay_s = round(rig.cable_delay_ps + rig.drift_ps_c * cold, 1) * 1e-12
        counts = super().clean(time_s, config)
        ranges, sizes = [], []
        if rig.person:
            mean, moves, period, size = _WALKER if rig.fault is Fault.PERSON else _PERSON
            ranges.append(mean + moves * math.sin(2 * math.pi * time_s / period))
            sizes.append(size)
        if rig.fault is Fault.OTHER_RADAR:
            rng = np.random.default_rng([self.seed, int(time_s * 1e6)])
            if rng.random() < 0.3:
                ranges += list(self.window(config).start_m + rng.uniform(0, 4, 4))
                sizes += list(rng.uniform(1, 3, 4))
        if ranges:
            more = Scene("more", room=StaticReturns(np.array(ranges), np.array(sizes)))
            counts = counts + self.room_echo(more, config).real * self.counts_per_unit(config)
        return counts


@cache
def measured_pulses() -> tuple[Pulse, ...]:
    """Pulses that P440 radars received from corner reflectors, antennas included."""
    text = (resources.files("tagid.simulate") / "measured_pulses.json").read_text("utf-8")
    data = json.loads(text)
    return tuple(Pulse(np.array(samples), data["step_s"]) for samples in data["pulses"].values())


def parse_rig(text: str) -> EmulatedRig:
    """The rig of `--rig`: a profile's file, or `realistic?seed=N`, with `&fault=NAME` if one is planted.

    Raises:
        UsageError: an unknown option. StorageError, FileFormatError: the profile cannot be read.
    """
    name, _, options = text.partition("?")
    if name != REALISTIC:
        return EmulatedRig.of(read_profile(Path(text)))
    query = RadarOptions(f"rig {text}", dict(parse_qsl(options)), "Use realistic?seed=N&fault=NAME.")
    seed = query.whole("seed", 0, 0, MAX_SEED)
    fault = query.text("fault")
    query.done()
    if fault is not None and fault not in list(Fault):
        raise UsageError(f"the fault of a rig is {fault[:40]!r}", f"Use {', '.join(Fault)}.")
    return EmulatedRig.random(seed, None if fault is None else Fault(fault))
