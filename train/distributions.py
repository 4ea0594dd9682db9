"""What the detector is trained on, declared as distributions: frozen values, each range with its reason.

A network knows only what it was trained on; this file shows where it may fail.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

from tagid.simulate.pulses import PulseShapes, Range


@dataclass(frozen=True)
class PulseDistribution:
    """Received pulses: the nominal one, or one drawn around those of real radars.

    Attributes:
        nominal: share of scenes with the nominal pulse.
        told: share of the others whose capture carries the pulse.
        shapes: ranges of the drawn pulses.
    """

    nominal: float = 0.5
    told: float = 0.5
    shapes: PulseShapes = field(default_factory=PulseShapes)


@dataclass(frozen=True)
class BodyDistribution:
    """Physical bodies (`tagid.simulate.objects`) and the octahedra on them.

    Attributes:
        kinds: bodies and their weights; can, cup, helmet and box are sized to fit inside the tag's circle.
        handle, seam, filled, oval: share of the bodies that can have them.
        standoff_m: from the wall to the middle of a reflector; octahedra touch it or stand off.
        reflector_m: size of the octahedra, m; the published tags use 20 and 40 mm.
        strength_db: standard deviation of the reflectors' strengths within a tag, dB.
        ring_m: distance of the tag's middle from the body's axis: nobody glues reflectors on exactly.
    """

    kinds: tuple[tuple[str, float], ...] = (
        ("none", 0.2),
        ("can", 0.25),
        ("cup", 0.25),
        ("helmet", 0.2),
        ("box", 0.1),
    )
    handle: float = 0.4
    seam: float = 0.3
    filled: float = 0.3
    oval: float = 0.3
    standoff_m: Range = (0.009, 0.02)
    reflector_m: Range = (0.016, 0.04)
    strength_db: Range = (0.0, 2.0)
    ring_m: Range = (0.0, 0.002)


@dataclass(frozen=True)
class ObjectDistribution:
    """Objects, their reflectors and what else on them echoes; amplitudes relative to a reflector.

    Everything on an object moves with it.

    Attributes:
        physical: share of objects whose body and reflectors are physical models; the others are simple ones,
            to which all that follows after `on_circle` applies.
        bodies: of the physical objects.
        counts: weight of 0, 1, 2, ... reflectors.
        radius_m: of the circle or disc that carries them.
        on_circle: share of objects whose reflectors lie on one circle; the others have them anywhere in it.
        spacing_m: least distance of two reflectors.
        spread: relative standard deviation of the reflectors' amplitudes.
        aspect_width_rad, aspect_floor: full width and floor of a reflector's bright side.
        isotropic: share of objects with isotropic reflectors.
        shell: share with a shell, its amplitude, and the offset of its axis from the object's, m.
        handles: share with one or two handles (narrow weak points off the shell) and their amplitude.
        rim: share with a rim (an arc of weak points) and its amplitude.
        bounce: share of objects where close reflectors make an interaction image, and its amplitude.
        box: share inside a cardboard box, and the amplitude of its faces.
    """

    physical: float = 0.6
    bodies: BodyDistribution = BodyDistribution()
    counts: tuple[float, ...] = (0.18, 0.06, 0.2, 0.28, 0.18, 0.06, 0.04)
    radius_m: Range = (0.04, 0.15)
    on_circle: float = 0.6
    spacing_m: float = 0.03
    spread: Range = (0.0, 0.25)
    aspect_width_rad: Range = (1.7, 4.0)
    aspect_floor: Range = (0.05, 0.6)
    isotropic: float = 0.35
    shell: float = 0.6
    shell_amplitude: Range = (0.1, 1.0)
    shell_offset_m: Range = (0.0, 0.006)
    handles: float = 0.3
    handle_amplitude: Range = (0.1, 0.5)
    rim: float = 0.2
    rim_amplitude: Range = (0.03, 0.15)
    bounce: float = 0.3
    bounce_amplitude: Range = (0.1, 0.5)
    box: float = 0.1
    box_amplitude: Range = (0.1, 0.6)


@dataclass(frozen=True)
class RecordingDistribution:
    """How the scenes are recorded.

    Attributes:
        views: numbers of views per turn, with weights.
        snr_db: per reflector, as `tagid.simulate.snr` defines it.
        colour: share of the noise that lies in the radar's band.
        interference, interference_db: share of scenes with a narrow-band tone, and its level over the noise.
        centre_m: distance of the object from the axis.
        elevation_m: height of the tag over the plane that the capture states.
        axis_error_m: given minus true axis distance.
        wobble: RMS deviation of the speed, relative.
        radial_m: RMS deviation of the axis distance.
        axis_distance_m: radar to axis.
        range_law: share of scenes with spreading and a 90 degree beam.
        room: share with static clutter.
    """

    views: tuple[tuple[int, float], ...] = ((12, 0.2), (18, 0.2), (36, 0.4), (72, 0.1), (180, 0.1))
    snr_db: Range = (-3.0, 25.0)
    colour: Range = (0.0, 1.0)
    interference: float = 0.15
    interference_db: Range = (-10.0, 3.0)
    centre_m: Range = (0.0, 0.015)
    elevation_m: Range = (-0.1, 0.1)
    axis_error_m: Range = (-0.015, 0.015)
    wobble: Range = (0.0, 0.015)
    radial_m: Range = (0.0, 0.0015)
    axis_distance_m: Range = (0.7, 2.0)
    range_law: float = 0.5
    room: float = 0.8


@dataclass(frozen=True)
class Distribution:
    """Everything that a training scene is drawn from."""

    pulse: PulseDistribution = PulseDistribution()
    object: ObjectDistribution = ObjectDistribution()
    recording: RecordingDistribution = RecordingDistribution()

    def fingerprint(self) -> str:
        """First 16 digits of the SHA-256 of all values, so that datasets of two distributions never mix."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def uniform(rng: np.random.Generator, bounds: Range) -> float:
    return float(rng.uniform(*bounds))


def spaced_points(
    count: int, radius_m: float, spacing_m: float, on_circle: bool, rng: np.random.Generator
) -> NDArray[np.float64]:
    """(K, 2) points on a circle or in its disc, at least spacing_m apart; fewer where there is no room."""
    chosen: list[NDArray[np.float64]] = []
    for _ in range(60 * max(count, 1)):
        if len(chosen) == count:
            break
        angle = rng.uniform(0, 2 * np.pi)
        r = radius_m if on_circle else radius_m * np.sqrt(rng.uniform())
        point = r * np.array([np.cos(angle), np.sin(angle)])
        if all(np.linalg.norm(point - other) >= spacing_m for other in chosen):
            chosen.append(point)
    return np.array(chosen, dtype=np.float64).reshape(-1, 2)
