"""What the detector is trained on, declared as distributions: one frozen value, every range with its reason.

A network knows what it has seen; who wants to know where it may fail reads this file.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

Range = tuple[float, float]


@dataclass(frozen=True)
class PulseDistribution:
    """Received pulses: the nominal one, or a main lobe with a ring and a late echo.

    The ranges of the second kind hold what least-squares fits of four Gabor atoms to seven pulses recorded
    with P440 radars gave (residual 4 to 10 % of the amplitude): main lobe at 3.98 to 4.28 GHz of 0.33 to
    0.69 ns, a ring within 1.1 ns, an echo of 0.18 to 0.34 at 1.6 to 2.3 ns.

    Attributes:
        nominal: share of scenes with the nominal pulse.
        told: share of the others whose capture carries the pulse.
        main_hz, main_sigma_s: of the main lobe.
        ring_amplitude, ring_delay_s, ring_hz, ring_sigma_s: of the ring, amplitude relative to the main lobe.
        late_amplitude, late_delay_s, late_hz, late_sigma_s: of the late echo.
    """

    nominal: float = 0.5
    told: float = 0.5
    main_hz: Range = (3.9e9, 4.3e9)
    main_sigma_s: Range = (0.2e-9, 0.6e-9)
    ring_amplitude: Range = (0.0, 0.4)
    ring_delay_s: Range = (0.3e-9, 1.1e-9)
    ring_hz: Range = (3.4e9, 4.4e9)
    ring_sigma_s: Range = (0.25e-9, 0.7e-9)
    late_amplitude: Range = (0.0, 0.35)
    late_delay_s: Range = (1.6e-9, 2.4e-9)
    late_hz: Range = (3.6e9, 4.0e9)
    late_sigma_s: Range = (0.25e-9, 0.6e-9)


@dataclass(frozen=True)
class ObjectDistribution:
    """Objects, their reflectors and what else on them echoes; amplitudes relative to a reflector.

    Attributes:
        counts: weight of 0, 1, 2, ... reflectors.
        radius_m: of the circle or disc that carries them.
        on_circle: share of objects whose reflectors sit on one circle; the others have them anywhere in it.
        spacing_m: least distance of two reflectors.
        spread: relative standard deviation of the reflectors' amplitudes.
        aspect_width_rad, aspect_floor: full width and floor of a reflector's bright side.
        isotropic: share of objects whose reflectors are alike to every side.
        shell: share with a shell, its amplitude, and how far its axis lies from the object's, m.
        handles: share with one or two handles: narrow weak points off the shell, their amplitude.
        rim: share with a rim, an arc of weak points, their amplitude.
        bounce: share of objects where near reflectors make an interaction image, its amplitude.
        box: share inside a cardboard box, the amplitude of its faces.
    """

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
        views: numbers of views a turn, with weights.
        snr_db: 20 log10(reflector's peak / noise std of one sample).
        centre_m: how far the object stands off the axis.
        axis_error_m: what the capture says of the axis distance minus the truth.
        wobble: RMS deviation of the speed, relative.
        radial_m: RMS deviation of the axis distance.
        axis_distance_m: radar to axis.
        range_law: share of scenes with spreading and a 90 degree beam.
        room: share with static clutter.
    """

    views: tuple[tuple[int, float], ...] = ((12, 0.2), (18, 0.2), (36, 0.4), (72, 0.1), (180, 0.1))
    snr_db: Range = (-3.0, 25.0)
    centre_m: Range = (0.0, 0.015)
    axis_error_m: Range = (-0.015, 0.015)
    wobble: Range = (0.0, 0.015)
    radial_m: Range = (0.0, 0.0015)
    axis_distance_m: Range = (0.7, 2.0)
    range_law: float = 0.5
    room: float = 0.8


@dataclass(frozen=True)
class Distribution:
    """All that a training scene is drawn from."""

    pulse: PulseDistribution = PulseDistribution()
    object: ObjectDistribution = ObjectDistribution()
    recording: RecordingDistribution = RecordingDistribution()

    def fingerprint(self) -> str:
        """First 16 digits of the SHA-256 of all values, so that datasets of two kinds never mix."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def uniform(rng: np.random.Generator, bounds: Range) -> float:
    """One value of a range."""
    return float(rng.uniform(*bounds))


def spaced_points(
    count: int, radius_m: float, spacing_m: float, on_circle: bool, rng: np.random.Generator
) -> NDArray[np.float64]:
    """(K, 2) points on a circle or in its disc, at least so far apart; fewer where there is no room."""
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
