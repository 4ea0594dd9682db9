"""A table on a cable and the radar that sees what it truly turns: both stop once the answer is certain."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tagid.live.engine import LiveSettings
from tagid.live.sure import EarlyEnding
from tagid.motion.emulation.pty import PtyPort
from tagid.motion.emulation.table import ComximCore
from tagid.motion.emulation.truth import TruthServer
from tagid.motion.urls import open_motion
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import load_capture
from tagid.pipeline.turn import resolve_turn
from tagid.radar.settings import RadarConfig
from tagid.reading.ending import EndingCalibration
from tagid.reading.looks import LOOKS
from tagid.recording.plan import RecordingPlan, plan_window
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tagid.tags.layouts.layout import builtin_layouts
from tests.unit.paced import paced

CALIBRATION = EndingCalibration("made up", (0, 3999), LOOKS, 32, 3999, ())


@pytest.mark.realtime
def test_a_table_stands_once_the_answer_is_certain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each scan waits for the looks, so the computer's speed decides only how far the table turns on."""
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "config.toml"))
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    core = ComximCore(rate_error=0.0, now_s=time.monotonic())
    with PtyPort(core) as port, TruthServer(core.table.state, 0) as truth:
        url = f"comxim+serial://{port.path}"
        motion = open_motion(url)
        layouts = list(builtin_layouts().values())
        plan = RecordingPlan(
            plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=13)), 1.0, motion=url
        )
        with EarlyEnding(LiveSettings(motion, layouts), CALIBRATION) as ending:
            watch = paced(ending, Watch(resolve=resolve_turn))
            radar = open_radar(f"emulator://helmet-120?rate=1&seed=2&turned_by={truth.address}")
            capture = record(radar, motion, plan, tmp_path / "x.tagid.h5", watch)
        assert not core.table.speed_deg_s
    ended = capture.radar.ended
    assert capture.complete and ended is not None
    assert (ended.reason, ended.layout) == ("sure", "helmet-120") and ended.share in LOOKS[1:]
    assert capture.angles_rad is not None and capture.motion.track is None
    assert ended.share < np.ptp(capture.angles_rad) / (2 * np.pi)
    turned = np.diff(capture.angles_rad)
    assert turned[turned < 0.1].sum() / (2 * np.pi) < 1, "without what it turned on during the looks"
    # The table turned on, unseen, while the scans waited for the looks: less may be seen than is needed.
    answer = identify(load_capture(capture), layouts)
    assert answer.reading is not None and answer.reading.nearest == "helmet-120"
