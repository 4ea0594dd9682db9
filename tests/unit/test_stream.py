"""One stream of scans for everything that reads a recording while it runs."""

from __future__ import annotations

import gc
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.errors import CaptureInterrupted, DataError
from tagid.live.engine import LiveSettings, LiveView
from tagid.live.sure import EarlyEnding
from tagid.metadata import Ending
from tagid.motion.urls import open_motion
from tagid.radar.assembler import Scan
from tagid.radar.settings import RadarConfig
from tagid.reading.ending import EndingCalibration
from tagid.reading.looks import LOOKS
from tagid.recording.plan import RecordingPlan, plan_window
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tagid.recording.session import Session
from tagid.recording.stream import ScanStream
from tagid.tags.layouts.layout import builtin_layouts
from tests.unit.paced import wait_for

SCANS = [Scan(n, 10 * n, 0, np.zeros(1, np.int32), 0, 1, 2) for n in range(2000)]
SESSION = cast(Session, SimpleNamespace())
URL = "free?rpm=20"
NEVER = EndingCalibration("made up", (0, 3999), LOOKS, 32, 3999, (1e9,))
"""Scans end early, but for no score that there is."""


def recorded(path: Path, watch: Watch) -> int:
    """Number of scans of a short recording in memory."""
    config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=13))
    radar = open_radar("emulator://helmet-120?rpm=20&seed=2")
    plan = RecordingPlan(config, 1.0, scans=60, motion=URL)
    return record(radar, open_motion(URL), plan, path, watch).views


def test_two_readers_get_every_scan_once_and_in_order_and_the_writer_waits_for_none() -> None:
    stream, written = ScanStream(SESSION), threading.Event()
    parts: dict[str, list[list[Scan]]] = {"fast": [], "slow": []}

    def read(name: str) -> None:
        count = 0
        while stream.wait(count):
            parts[name].append(stream.since(count))
            count += len(parts[name][-1])
            if name == "slow":
                assert written.wait(60)

    readers = [threading.Thread(target=read, args=(name,), daemon=True) for name in parts]
    for reader in readers:
        reader.start()
    stream.append(SCANS[0])
    wait_for(lambda: parts["slow"])
    for scan in SCANS[1:]:
        stream.append(scan)
        if scan.scan_id % 500 == 0:
            wait_for(lambda: sum(map(len, parts["fast"])) == len(stream))
    assert len(parts["slow"]) == 1, "it reads only once everything is written"
    written.set()
    stream.end()
    for reader in readers:
        reader.join(60)
        assert not reader.is_alive()
    for name, read_parts in parts.items():
        assert [scan for part in read_parts for scan in part] == SCANS, name
    assert len(parts["slow"]) == 2 and len(parts["fast"]) > 3


def test_a_reader_waits_for_the_next_scan_the_end_or_its_time() -> None:
    stream = ScanStream(SESSION)
    assert (len(stream), stream.since(), stream.newest_s) == (0, [], None)
    assert not stream.wait(0, 0.01) and not stream.ended
    stream.append(SCANS[0])
    assert stream.wait(0) and not stream.wait(1, 0.01) and stream.newest_s is not None
    first_s = stream.newest_s
    stream.append(SCANS[1])
    assert stream.newest_s > first_s
    late = threading.Timer(0.05, stream.end)
    late.start()
    assert not stream.wait(2) and stream.ended
    assert stream.wait(0), "what was recorded can be read after the end"
    late.join()


def test_view_and_early_ending_of_a_recording_read_the_same_stream(tmp_path: Path) -> None:
    settings = LiveSettings(open_motion(URL), list(builtin_layouts().values()))
    streams: list[ScanStream] = []
    alive: list[ScanStream] = []

    def all_streams() -> list[ScanStream]:
        return [thing for thing in gc.get_objects() if type(thing) is ScanStream]

    # What earlier tests of this process left is held, so that it cannot go meanwhile.
    earlier = all_streams()

    def enough() -> Ending | None:
        if len(streams[0]) == 50:
            wait_for(lambda: view.state.scans and ending.considered == 50)
            alive[:] = all_streams()
        return None

    with LiveView(settings) as view, EarlyEnding(settings, NEVER) as ending:

        def began(stream: ScanStream) -> None:
            streams.append(stream)
            view.began(stream)

        watch = replace(ending.watching(Watch(began=began)), enough=enough)
        views = recorded(tmp_path / "x.tagid.h5", watch)
        wait_for(lambda: view.state.scans == ending.considered == views)
        (stream,) = streams
        assert [result for result in alive if result not in earlier] == streams, "there is no second one"
        assert len(stream) == views and stream.ended and not view.silent_s


def test_a_stream_ends_however_its_recording_does(tmp_path: Path) -> None:
    streams: list[ScanStream] = []

    def fails(stream: ScanStream) -> None:
        streams.append(stream)
        raise RuntimeError("a fault in a watcher")

    with pytest.raises(Exception, match="a fault in a watcher"):
        recorded(tmp_path / "a.tagid.h5", Watch(began=fails))
    with pytest.raises(CaptureInterrupted):
        recorded(tmp_path / "b.tagid.h5", Watch(began=streams.append, stop=lambda: len(streams[-1]) > 2))
    assert [stream.ended for stream in streams] == [True, True]
    assert len(streams[1]) == 3


def test_a_recording_says_whether_it_waits_for_a_scan_or_searches_those_it_has(tmp_path: Path) -> None:
    """A radar whose recording is busy is not silent."""
    streams: list[ScanStream] = []
    waits: list[float] = []

    def resolve(capture: Capture, motion: str) -> Capture:
        waits.append(streams[0].silent_s)
        raise DataError("no angles")

    watch = Watch(
        began=streams.append, resolve=resolve, progress=lambda *_: waits.append(streams[0].silent_s)
    )
    recorded(tmp_path / "a.tagid.h5", watch)
    assert len(waits) > 1 and not any(waits)
    stream = ScanStream(SESSION)
    assert stream.silent_s == 0
    for scan in SCANS[:2]:
        stream.append(scan)
        assert stream.silent_s == 0
        stream.await_next()
        assert stream.silent_s > 0
    stream.end()
    assert stream.silent_s == 0
