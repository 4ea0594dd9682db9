"""A simulated recording as an ordinary capture, together with its ground truth.

The values given in the capture (angles, axis distance, height) may deliberately differ from the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, ViewFlag
from tagid.errors import UsageError
from tagid.metadata import MotionInfo, ObjectInfo, RadarInfo, ResolvedMotion, SimulatedTruth
from tagid.simulate.acquisition import Acquisition, Turn
from tagid.simulate.noise import draw_noise
from tagid.simulate.render import PulseTable, antennas, echo_levels, render_bodies, render_room
from tagid.simulate.scene import Scene
from tagid.simulate.snr import EchoLevels, Snr, noise_std_for


@dataclass(frozen=True, eq=False)
class Truth:
    """The true values behind a capture.

    Attributes:
        angles_rad: (views,) object angle, rad.
        times_s: (views,) time since the start, s.
        axis_distance_m: mean distance, m.
        positions_m: (n, 2) reflectors as placed, at angle zero, m.
        amplitudes: (n,) complex128 relative strengths of the reflectors.
        noise_std: standard deviation of one sample, in the capture's units, without interference.
        levels: peaks to which the SNR refers, in the capture's units.
        snr: SNR, and peaks over the noise.
        clean: (views, bins) samples without noise, quantisation and clipping, float64 or complex128.
    """

    angles_rad: NDArray[np.float64]
    times_s: NDArray[np.float64]
    axis_distance_m: float
    positions_m: NDArray[np.float64]
    amplitudes: NDArray[np.complex128]
    noise_std: float
    levels: EchoLevels
    snr: Snr
    clean: NDArray[np.float64] | NDArray[np.complex128]


def _recorded(
    clean: NDArray[np.complex128], noise_std: float, acquisition: Acquisition, rng: np.random.Generator
) -> tuple[NDArray[np.float32] | NDArray[np.int32] | NDArray[np.complex64], NDArray[np.uint8]]:
    """Samples in the requested type and (views,) flags; complex noise has a total std of noise_std."""
    flags = np.zeros(len(clean), dtype=np.uint8)
    recording, ranges = acquisition.recording, acquisition.range_window.ranges_m
    noise = draw_noise(acquisition.noise, ranges, len(clean), rng)
    if recording.dtype == "complex64":
        both = noise + 1j * draw_noise(acquisition.noise, ranges, len(clean), rng)
        signal = clean + noise_std / np.sqrt(2) * both
        return (recording.counts_per_unit * signal).astype(np.complex64), flags
    counts = recording.counts_per_unit * (clean.real + noise_std * noise)
    if recording.clip_counts is not None:
        clipped = (np.abs(counts) >= recording.clip_counts).any(axis=1)
        flags[clipped] |= np.uint8(ViewFlag.CLIPPED)
        counts = np.clip(counts, -recording.clip_counts, recording.clip_counts)
    if recording.dtype == "int32":
        info = np.iinfo(np.int32)
        return np.clip(np.rint(counts), info.min, info.max).astype(np.int32), flags
    return counts.astype(np.float32), flags


def _noise_std(acquisition: Acquisition, levels: EchoLevels) -> float:
    """Standard deviation of one sample, relative to the peak of a unit reflector on the axis."""
    if acquisition.noise_std is not None:
        return acquisition.noise_std
    if acquisition.snr_db is None:
        return 0.0
    return noise_std_for(acquisition.snr_db, levels.of(acquisition.snr_reference))


def object_settings(scene: Scene, acquisition: Acquisition, snr: Snr) -> ObjectInfo:
    """The capture's object field: the scene, and the true acquisition parameters.

    Only this function writes the field. No reading command uses these values; they are for the evaluation of
    results.
    """
    place = acquisition.placement
    truth = SimulatedTruth(
        rotation_deg=float(np.rad2deg(place.rotation_rad)),
        centre_m=tuple(float(value) for value in place.centre_m),
        elevation_m=place.height_m,
        axis_distance_m=acquisition.axis_distance_m,
        wobble_speed=acquisition.wobble.speed,
        wobble_radial_m=acquisition.wobble.radial_m,
        pulse="nominal" if acquisition.pulse is None else "other",
        noise_colour=acquisition.noise.colour,
        snr_db=snr.changing_db,
        snr_reflector_db=snr.reflector_db,
        snr_summed_db=snr.summed_db,
        snr_reference_db=snr.reference_db,
    )
    return replace(ObjectInfo.from_json({"scene": scene.name, **scene.description}), truth=truth)


def _check_clear(scene: Scene, acq: Acquisition) -> None:
    """Raises UsageError if a reflector comes as far out as the antenna."""
    if scene.tag is None or not len(scene.tag.positions):
        return
    reach = float(
        np.hypot(*acq.placement.centre_m) + np.linalg.norm(scene.tag.positions[:, :2], axis=1).max()
    )
    if reach > acq.axis_distance_m:
        raise UsageError(
            f"reflectors reach {reach:.3g} m from the axis, the antenna stands at {acq.axis_distance_m:g} m",
            "Give a larger axis distance.",
        )


def simulate_capture(
    scene: Scene, acquisition: Acquisition | None = None, seed: int = 0
) -> tuple[Capture, Truth]:
    """Record a rotating scene.

    y[v, b] = sum_k a_k(v) s(2 (R_b - d_k(v)) / c) + noise, with the pulse s at RF (paper, eq. 1) and d_k the
    distance from the antenna, whose position in the object's frame is that of `Aperture.turntable`, or the
    mean of the distances from two antennas.

    Args:
        acquisition: acquisition parameters; the default is one noise-free turn of 360 views.
        seed: random seed of wobble, angle errors and noise.

    Returns:
        the capture (with angles, axis distance and a radar clock in whole milliseconds as a file would state
        them), and the truth.

    Raises UsageError if the object's reflectors would pass the antenna.
    """
    acq = Acquisition() if acquisition is None else acquisition
    _check_clear(scene, acq)
    rng = np.random.default_rng(seed)
    window, table = acq.range_window, PulseTable.of(acq.pulse)
    turn = Turn.random(acq.wobble, acq.direction, rng)
    turns = np.arange(acq.scans) / acq.views
    angles = turn.angles(turns)
    antenna = antennas(angles, acq.axis_distance_m + turn.radial(turns), acq.antenna_height_m)

    clean = render_bodies(scene.object, acq.placement, antenna, acq, table)
    clean += render_room(scene, window, table)
    levels = echo_levels(scene, acq, antenna, table)
    noise_std = _noise_std(acq, levels)
    snr = Snr.of(levels, noise_std, clean)

    stated = acq.direction * 2 * np.pi * turns + acq.angle_error_rad * rng.standard_normal(acq.scans)
    samples, flags = _recorded(clean, noise_std, acq, rng)
    times = turns * acq.period_s
    flags[0] |= np.uint8(ViewFlag.FIRST)
    capture = Capture(
        samples=samples,
        range_start_m=window.start_m,
        range_step_m=window.step_m,
        angles_rad=stated,
        angle_sigma_rad=np.full(acq.scans, acq.angle_error_rad),
        axis_distance_m=acq.axis_distance_m + acq.axis_distance_error_m,
        antenna_height_m=acq.antenna_height_m,
        antenna_separation_m=acq.antenna_separation_m,
        radar_time_ms=np.floor(times * 1e3 + rng.uniform()),
        scan_id=np.arange(acq.scans, dtype=np.int64),
        flags=flags,
        pulse=acq.pulse if acq.tell_pulse else None,
        radar=RadarInfo(kind="simulated", seed=seed),
        motion=MotionInfo(
            kind="simulated",
            resolved=ResolvedMotion(
                kind="simulated", source="simulated", period_s=acq.period_s, direction=acq.direction
            ),
        ),
        object=object_settings(scene, acq, snr),
    )
    gain = acq.recording.counts_per_unit
    tag = scene.tag
    truth = Truth(
        angles_rad=angles,
        times_s=times,
        axis_distance_m=acq.axis_distance_m,
        positions_m=np.zeros((0, 2)) if tag is None else acq.placement.apply(tag.positions[:, :2]),
        amplitudes=np.zeros(0, complex) if tag is None else tag.amplitudes.astype(np.complex128),
        noise_std=noise_std * gain,
        levels=replace(levels, reflector=levels.reflector * gain, summed=levels.summed * gain),
        snr=snr,
        clean=gain * (clean if acq.recording.dtype == "complex64" else clean.real),
    )
    return capture, truth
