"""The metadata of a capture: types, files of older versions, and a recording made over the wire."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_server import Ran

from tagid.errors import DataError, FileFormatError
from tagid.metadata import METADATA_VERSION, MotionInfo, ObjectInfo, RadarInfo, RadarSettings, ResolvedMotion
from tagid.motion.urls import open_motion
from tagid.pipeline.turn import resolve_turn
from tagid.radar.settings import RadarConfig
from tagid.recording.inspection import inspect
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tagid.storage.hdf5 import FORMAT_VERSION
from tagid.storage.importers import read_any
from tagid.storage.metadata import read_metadata

GOLDEN = Path(__file__).parents[1] / "data" / "captures"


@pytest.mark.parametrize(
    ("version", "suffix"),
    [(n, suffix) for n in range(1, METADATA_VERSION + 1) for suffix in (".npz", ".tagid.journal")]
    + [(n, ".tagid.h5") for n in range(1, FORMAT_VERSION + 1)],
)
def test_files_of_every_version_are_read_alike(version: int, suffix: str) -> None:
    capture = read_any(GOLDEN / f"version-{version}{suffix}")
    assert capture.samples.shape == (64, 192) and capture.complete
    assert capture.radar.config == RadarSettings(
        scan_start_ps=3156, scan_stop_ps=14875, node_id=1, base_integration_index=13,
        antenna_mode=2, transmit_gain=50, code_channel=0, persist=0,
    )  # fmt: skip
    assert capture.radar.config_asked is not None and capture.radar.config_asked.scan_start_ps == 3157
    assert (capture.radar.serial, capture.radar.scans_lost, capture.radar.gap_count) == (1088, 0, 0)
    assert capture.motion.url == "free?rpm=20" and capture.object == ObjectInfo(note="golden")
    if suffix != ".tagid.journal":
        assert capture.angles_rad is not None
        assert capture.motion.resolved.nominal_rpm == 20.0 and capture.motion.resolved.period_s == 3.0
    assert not capture.radar.extra and not capture.motion.extra


def test_a_recording_over_the_wire_is_shown_with_its_own_clipping_limit(
    tmp_path: Path, tagid: Callable[..., Ran]
) -> None:
    """Integration 6 clips at 127 * 2^6 = 8128 counts, far below what a sample can hold."""
    path = tmp_path / "loud.tagid.h5"
    plan = RecordingPlan(RadarConfig(base_integration_index=6), 1.0, scans=40, motion="free?rpm=20")
    watch = Watch(resolve=resolve_turn)
    radar = open_radar("emulator://helmet-120?seed=3&rpm=20&snr=70")
    capture = record(radar, open_motion("free?rpm=20"), plan, path, watch)
    limit = 127 << 6
    clipped = float(np.mean(np.abs(capture.samples) >= limit))
    assert capture.radar.clip_counts == limit and inspect(capture).clipped_fraction == clipped
    assert tagid("show", path, "--output", "json").json["data"]["clipped_fraction"] == clipped


@pytest.mark.parametrize(
    ("part", "values", "named"),
    [
        ("radar", {"scans_lost": "many"}, "scans_lost"),
        ("radar", {"scans_lost": True}, "scans_lost"),
        ("radar", {"config": [1]}, "config"),
        ("radar", {"config": {"transmit_gain": 6.5}}, "transmit_gain"),
        ("radar", {"gaps": [{"after_scan": 1}]}, "restarted"),
        ("radar", {"gaps": [{"unknown": 1}]}, "unknown"),
        ("motion", {"resolved": {"period_s": float("inf")}}, "period_s"),
        ("motion", {"track": {"host_time_ns": [1], "angle_rad": [], "sigma_rad": []}}, "track"),
        ("object", {"label": 5}, "label"),
    ],
)
def test_a_known_key_of_another_type_is_an_error_that_names_it(part: str, values: dict, named: str) -> None:
    with pytest.raises(FileFormatError, match="a file") as caught:
        read_metadata({part: values}, "a file")
    assert named in caught.value.message


def test_values_made_by_hand_are_checked_as_well() -> None:
    with pytest.raises(DataError, match="whole number"):
        RadarSettings(transmit_gain="x")  # type: ignore[arg-type]
    with pytest.raises(DataError, match="finite"):
        ResolvedMotion(period_s=float("nan"))


def test_version_1_put_settings_and_facts_where_nobody_looked() -> None:
    old = {
        "radar": {"base_integration_index": 11, "scans_lost": "?", "site": 3},
        "motion": {"rpm": 2.0, "period_s": 6.0, "source": "data"},
        "object": {"label": "x"},
    }
    new = read_metadata(old, "a file", version=1)
    assert new["radar"] == RadarInfo(config=RadarSettings(base_integration_index=11), extra={"site": 3})
    assert new["motion"] == MotionInfo(nominal_rpm=2.0, resolved=ResolvedMotion(period_s=6.0, source="data"))
    assert read_metadata({k: v.to_json() for k, v in new.items()}, "a file") == new
    with pytest.raises(FileFormatError, match="version 3"):
        read_metadata(old, "a file", version=METADATA_VERSION + 1)
