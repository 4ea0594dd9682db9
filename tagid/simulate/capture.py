"""A simulated recording as an ordinary capture, with the truth beside it.

What the capture claims (angles, axis distance) may be wrong on purpose; the truth never is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, ViewFlag
from tagid.metadata import MotionInfo, ObjectInfo, RadarInfo, ResolvedMotion
from tagid.simulate.acquisition import Acquisition, Recording, Turn
from tagid.simulate.render import PulseTable, antennas, render_bodies, render_room
from tagid.simulate.scene import Scene


@dataclass(frozen=True, eq=False)
class Truth:
    """What really was.

    Attributes:
        angles_rad: (views,) object angle, rad.
        times_s: (views,) since the start, s.
        axis_distance_m: mean distance, m.
        positions_m: (n, 2) point reflectors as placed, at angle zero, m.
        amplitudes: (n,) complex128.
        noise_std: of one sample, in the capture's units.
        reference: peak that the SNR refers to, in the capture's units.
        clean: (views, bins) samples without noise, quantisation and clipping, float64 or complex128.
    """

    angles_rad: NDArray[np.float64]
    times_s: NDArray[np.float64]
    axis_distance_m: float
    positions_m: NDArray[np.float64]
    amplitudes: NDArray[np.complex128]
    noise_std: float
    reference: float
    clean: NDArray[np.float64] | NDArray[np.complex128]


def _noise_level(
    scene: Scene, acquisition: Acquisition, turning: NDArray[np.complex128]
) -> tuple[float, float]:
    """(noise std, reference peak) where a unit reflector at the axis peaks at 1."""
    peak = float(np.abs(turning).max(initial=0.0))
    reference = scene.reference_amplitude if scene.reference_amplitude is not None else peak or 1.0
    if acquisition.noise_std is not None:
        return acquisition.noise_std, reference
    if acquisition.snr_db is None:
        return 0.0, reference
    return reference / 10 ** (acquisition.snr_db / 20), reference


def _recorded(
    clean: NDArray[np.complex128], noise_std: float, recording: Recording, rng: np.random.Generator
) -> tuple[NDArray[np.float32] | NDArray[np.int32] | NDArray[np.complex64], NDArray[np.uint8]]:
    """Samples in the wanted type and (views,) flags; complex noise has std noise_std in all."""
    flags = np.zeros(len(clean), dtype=np.uint8)
    if recording.dtype == "complex64":
        noise = rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)
        signal = clean + noise_std / np.sqrt(2) * noise
        return (recording.counts_per_unit * signal).astype(np.complex64), flags
    counts = recording.counts_per_unit * (clean.real + noise_std * rng.standard_normal(clean.shape))
    if recording.clip_counts is not None:
        clipped = (np.abs(counts) >= recording.clip_counts).any(axis=1)
        flags[clipped] |= np.uint8(ViewFlag.CLIPPED)
        counts = np.clip(counts, -recording.clip_counts, recording.clip_counts)
    if recording.dtype == "int32":
        info = np.iinfo(np.int32)
        return np.clip(np.rint(counts), info.min, info.max).astype(np.int32), flags
    return counts.astype(np.float32), flags


def simulate_capture(
    scene: Scene, acquisition: Acquisition | None = None, seed: int = 0
) -> tuple[Capture, Truth]:
    """Record a turning scene.

    y[v, b] = sum_k a_k(v) s(2 (R_b - d_k(v)) / c) + noise, with the pulse s at RF (paper, eq. 1) and d_k the
    distance from the antenna, which in the object's frame stands where `Aperture.turntable` puts it.

    Args:
        scene: what reflects.
        acquisition: how it is recorded; the default is one noise-free turn of 360 views.
        seed: of wobble, angle errors and noise; the same seed gives the same capture.

    Returns:
        the capture (its angles, axis distance and whole-millisecond radar clock as a file would claim them),
        and the truth.
    """
    acq = Acquisition() if acquisition is None else acquisition
    rng = np.random.default_rng(seed)
    window, table = acq.range_window, PulseTable.of(acq.pulse)
    turn = Turn.random(acq.wobble, acq.direction, rng)
    turns = np.arange(acq.scans) / acq.views
    angles = turn.angles(turns)
    antenna = antennas(angles, acq.axis_distance_m + turn.radial(turns), acq.antenna_height_m)

    turning = np.zeros((acq.scans, window.bins), dtype=np.complex128)
    render_bodies(scene.object, acq.placement, antenna, acq, table, turning)
    noise_std, reference = _noise_level(scene, acq, turning)
    clean = turning + render_room(scene, window, table)
    render_bodies(scene.turntable, type(acq.placement)(), antenna, acq, table, clean)

    believed = acq.direction * 2 * np.pi * turns + acq.angle_error_rad * rng.standard_normal(acq.scans)
    samples, flags = _recorded(clean, noise_std, acq.recording, rng)
    times = turns * acq.period_s
    flags[0] |= np.uint8(ViewFlag.FIRST)
    capture = Capture(
        samples=samples,
        range_start_m=window.start_m,
        range_step_m=window.step_m,
        angles_rad=believed,
        angle_sigma_rad=np.full(acq.scans, acq.angle_error_rad),
        axis_distance_m=acq.axis_distance_m + acq.axis_distance_error_m,
        antenna_height_m=acq.antenna_height_m,
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
        object=ObjectInfo.from_json({"scene": scene.name, **scene.description}),
    )
    gain = acq.recording.counts_per_unit
    truth = Truth(
        angles_rad=angles,
        times_s=times,
        axis_distance_m=acq.axis_distance_m,
        positions_m=placed_positions(scene, acq),
        amplitudes=scene.points.amplitudes.astype(np.complex128)
        if scene.points
        else np.zeros(0, np.complex128),
        noise_std=noise_std * gain,
        reference=reference * gain,
        clean=gain * (clean if acq.recording.dtype == "complex64" else clean.real),
    )
    return capture, truth


def placed_positions(scene: Scene, acquisition: Acquisition) -> NDArray[np.float64]:
    """(n, 2) point reflectors after placement: turned by its rotation, then shifted by its centre."""
    if scene.points is None:
        return np.zeros((0, 2))
    return acquisition.placement.apply(scene.points.positions[:, :2])
