"""The clock of the computer is set while a program runs: by an hour, forwards and backwards."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from tagid.angles.align import NotAlignedError, align
from tagid.angles.clock import fit_clock
from tagid.metadata import MotionInfo, Track
from tagid.pipeline.diagnosis import recording_remarks
from tagid.pipeline.turn import resolve_turn
from tagid.simulate import Acquisition, scene_from_name, simulate_capture
from tagid.storage import history as history_module
from tagid.storage.history import Filter, History

EPOCH_NS = 1_750_000_000_000_000_000
RECORDING = """
import sys, time
real_ns, reads, imported = time.time_ns, 0, False
def set_twice():
    global reads
    reads += imported
    return real_ns() + (0 if reads <= 20 else -HOUR if reads <= 40 else HOUR)
HOUR = 3600 * 10**9
time.time_ns, time.time = set_twice, lambda: set_twice() * 1e-9  # before anything keeps a reference

from pathlib import Path
import numpy as np
from tagid.motion.urls import open_motion
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.recording.recorder import record

imported = True
began, wall = time.monotonic_ns(), real_ns()
plan = RecordingPlan(None, 1.0, scans=60, max_seconds=60.0)
capture = record(open_radar("emulator://points-3"), open_motion("free?rpm=6"), plan, Path(sys.argv[1]))
assert capture.complete and capture.views == 60
assert np.diff(capture.host_time_ns).min() >= 0, np.diff(capture.host_time_ns)
assert 0 < np.ptp(capture.host_time_ns) <= time.monotonic_ns() - began
assert abs(int(capture.host_time_ns[0]) - wall) < 60 * 10**9
"""


def test_a_recording_does_not_notice(tmp_path: Path) -> None:
    words = [sys.executable, "-c", RECORDING, str(tmp_path / "a.tagid.h5")]
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


def test_angles_of_a_recording_whose_clock_was_set_are_refused() -> None:
    rng = np.random.default_rng(1)
    scans, readings = np.arange(0, 20, 0.02), np.arange(-0.5, 21, 0.05)

    def stamped(times: np.ndarray, step_s: float) -> np.ndarray:
        late = rng.exponential(0.004, len(times)) + np.where(times > 9, step_s, 0.0)
        return EPOCH_NS + ((times + late) * 1e9).astype(np.int64)

    def angles_with(step_s: float, stall_s: float = 0.0) -> np.ndarray:
        arrivals = stamped(scans, step_s)
        stalled = (scans > 12) & (scans < 12 + stall_s)
        arrivals[stalled] = EPOCH_NS + int((12 + stall_s) * 1e9)
        track = Track(stamped(readings, step_s), 0.6 * readings, np.full(len(readings), 1e-3), {})
        return align(fit_clock(np.floor(scans * 1e3)), arrivals, track).angles_rad

    for step_s in (-1.0, -3600.0):
        with pytest.raises(NotAlignedError, match=re.escape(f"set by about {step_s:+.1f} s")):
            angles_with(step_s)
    for step_s in (1.0, 3600.0):  # Scans that wait to the end look alike.
        with pytest.raises(
            NotAlignedError, match=f"^scans arrived {step_s:.1f} s late: .* busy, or its clock"
        ):
            angles_with(step_s)
    # A network that holds everything back for three seconds is no step of the clock.
    assert np.abs(angles_with(0.0, stall_s=3.0) - 0.6 * scans).max() < 0.02


@pytest.mark.parametrize(("late_s", "turns"), [(0.6, 1.4), (-3600.0, 1.4), (0.6, 0.7)])
def test_the_period_in_the_scans_replaces_angles_that_cannot_be_assigned(late_s: float, turns: float) -> None:
    acquisition = Acquisition(views=200, turns=turns, snr_db=20.0, period_s=10.0)
    recorded, _ = simulate_capture(scene_from_name("helmet-120", 3), acquisition, 3)
    times = recorded.radar_time_ms * 1e-3
    late = np.where(times > 0.6 * times[-1], late_s, 0.0)
    readings = np.arange(0, times[-1], 0.05)
    track = Track.of([(EPOCH_NS + int(t * 1e9), -0.63 * t, 1e-3) for t in readings], {"kind": "roomba"})
    capture = replace(
        recorded,
        angles_rad=None,
        angle_sigma_rad=None,
        host_time_ns=EPOCH_NS + ((times + late) * 1e9).astype(np.int64),
        motion=MotionInfo(url="roomba+serial:///dev/ttyUSB1", track=track),
    )
    if turns < 1:
        with pytest.raises(NotAlignedError):
            resolve_turn(capture)
        return
    motion = (result := resolve_turn(capture)).motion
    assert motion.resolved is not None and motion.track is None and motion.url == capture.motion.url
    assert motion.resolved.period_s == pytest.approx(10.0, rel=0.01) and motion.resolved.direction == -1
    (remark,) = recording_remarks(result)
    assert "cannot be assigned to the scans; their period is used instead" in remark


def test_the_history_stays_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = datetime(2026, 11, 22, 12, tzinfo=UTC)

    class Set(datetime):
        @classmethod
        def now(cls, tz: object = None) -> datetime:
            return now

    monkeypatch.setattr(history_module, "datetime", Set)
    history = History(tmp_path / "history.sqlite")
    run = history.begin("identify", {})
    record = dict.fromkeys(("file", "label", "reason"), "x") | {"status": "unknown", "tool_version": "1"}
    numbers = dict.fromkeys(("score", "margin", "missing", "extra"), 0)
    for number, shift in enumerate((0, -1, 1)):
        now += timedelta(hours=shift)
        history.add(run, [record | numbers | {"file": str(number)}])
    assert [entry.file for entry in history.find()] == ["2", "1", "0"]
    assert [entry.file for entry in history.find(Filter(limit=1))] == ["2"]
