"""The live view at a P440's pace on one core: frames per second, scans lost, and how late the answer is.

The emulated radar runs in a process of its own and is not counted; recording, live view and reading are
pinned to one core.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tagid.enrolling.registry import Registry
from tagid.live.engine import LiveSettings, LiveView
from tagid.live.state import LiveState
from tagid.motion.urls import open_motion
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.pipeline.turn import resolve_turn
from tagid.radar.settings import RadarConfig
from tagid.recording.plan import RecordingPlan, capture_path, plan_window
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tests.benchmarks.measure import started
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

CASES = (
    ("helmet-120", True, 15),
    ("container-90", True, 11),
    ("helmet-120", False, 15),
    ("container-90", False, 11),
)
"""Scene, whether the speed is stated, integration index."""
RPM = 6.0
COLUMNS = (
    "scene, speed | scans | scans per second | lost, dropped | frames | frames per second | "
    "share of the core | answer | after the last scan (s)"
)


def frames(run: Run) -> Iterator[Table]:
    run.seeds = "the emulator's default, 0"
    repeats = run.number(2)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rows = []
    for scene, stated, integration in CASES[:1] if run.quick else CASES:
        words = ["emulate", "p440", "--bind", "127.0.0.1:0", "--scene", scene, "--rpm", str(RPM)]
        with started(words) as emulator:
            motion = f"free?rpm={RPM:g}" if stated else "free"
            for _ in range(repeats):
                label = f"{scene}, {'stated' if stated else 'from the scans'}"
                rows.append((label, *scan(emulator["url"], motion, integration, run.folder)))
    yield Table(COLUMNS, rows)


def scan(url: str, motion_url: str, integration: int, folder: Path) -> tuple[object, ...]:
    known = Registry(folder / "registry.sqlite").contents()
    config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=integration))
    motion = open_motion(motion_url)
    plan = RecordingPlan(config, 1.0, motion=motion_url, renumber=True)
    frames: list[tuple[float, int]] = []

    def tell(state: LiveState) -> None:
        frames.append((time.monotonic(), state.views))

    with LiveView(LiveSettings(motion, known.layouts), tell) as view:
        watch = Watch(resolve=view.resolving(resolve_turn), began=view.began)
        began = time.process_time()
        capture = record(open_radar(url, 2.0), motion, plan, capture_path(folder), watch)
        spent = time.process_time() - began
        during = [at for at, views in frames if views > 1]
        prepared = PreparedCapture(load_capture(capture))
        answer = identify(prepared, known.layouts)
        view.settle(prepared.given, answer)
    seconds = float(np.ptp(capture.radar_time_ms)) * 1e-3
    rate = round((len(during) - 1) / (during[-1] - during[0]), 2) if during[1:] else "-"
    named = view.state.answer.reading.layout if view.state.answer and view.state.answer.reading else "none"
    return (
        capture.views, f"{capture.views / seconds:.1f}",
        f"{capture.radar.scans_lost}, {capture.radar.scans_dropped}",
        len(during), rate, f"{spent / seconds:.2f}", named, f"{view.state.answer_after_s or 0.0:.2f}",
    )  # fmt: skip
