"""What the station sends and accepts: pictures, states, numbers of the history, and keys of connections."""

from __future__ import annotations

import base64
import json
import math
import threading
from pathlib import Path
from typing import cast
from urllib.parse import urlencode

import numpy as np
import pytest
from starlette.requests import Request

from tagid.errors import DataError, DeviceError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.types import Image
from tagid.live.state import LiveState, Phase, Sinogram
from tagid.operate.workplace import Workplace
from tagid.radar.assembler import Scan
from tagid.reading.preview import LayoutEvidence
from tagid.recording.plan import RecordingPlan
from tagid.recording.session import Session
from tagid.recording.stream import ScanStream
from tagid.station import wire
from tagid.station.operators import GRACE_S, Operators
from tagid.station.requests import entries_of, filter_of
from tagid.station.scans import ScanRun
from tagid.station.station import HISTORY_LIMIT


def levels(picture: wire.Json, width: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(picture["levels"]), np.uint8)
    return data.reshape(-1, picture[width])


def test_a_picture_has_y_upwards_its_peak_white_and_its_floor_black() -> None:
    values = np.full((8, 8), 1e-6, np.complex64)
    values[7, 2] = 2j  # the largest y
    values[0, 5] = 2 * 10 ** (-wire.IMAGE_DB / 2 / 20)
    image = wire.pictures(LiveState(image=Image(values, ImageGrid(0.4, 8))))["image"]
    pixels = levels(image, "side")
    assert (pixels[0, 2], pixels[7, 5]) == (255, 128)
    assert np.count_nonzero(pixels) == 2
    rows = np.linspace(1, 2, 40 * 30).reshape(40, 30).astype(np.float32)
    sinogram = wire.pictures(LiveState(sinogram=Sinogram(rows, (0.5, 1.5))))["sinogram"]
    assert levels(sinogram, "columns").max() == 255 and sinogram["range_m"] == [0.5, 1.5]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ScanRun:
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    place = Workplace({"radar.url": "emulator://empty", "motion.url": "free?rpm=2", "imaging.method": "bp"})
    return ScanRun(3, place, RecordingPlan(None, 1.0), threading.Lock())


def test_a_scan_is_described_in_degrees_with_rounded_evidence(run: ScanRun) -> None:
    evidence = LayoutEvidence("b", 30.04, 12.04), LayoutEvidence("c", 18.0, -12.04)
    run.view._publish(phase=Phase.TURNING, turned_rad=2.5 * np.pi, evidence=evidence)
    described = wire.scan(run)
    assert (described["turned_deg"], described["turn_share"]) == (450.0, 1.0)
    assert described["evidence"] == [
        {"layout": "b", "log_evidence": 30.0, "lead": 12.0},
        {"layout": "c", "log_evidence": 18.0, "lead": -12.0},
    ]


def test_only_a_radar_that_the_recording_waits_for_is_silent(run: ScanRun) -> None:
    stream = ScanStream(cast(Session, None))
    run._watch().began(stream)
    assert run.view.silent_s == 0, "before the first scan"
    stream.append(cast(Scan, None))
    assert run.view.silent_s == 0, "the recording searches its scans for a turn, and may end with them"
    stream.await_next()
    assert run.view.silent_s > 0
    stream.end()
    assert run.view.silent_s == 0
    for error, failed in ((DeviceError("no answer", ""), True), (DataError("no tag", ""), False)):
        run._fail(error)
        assert run.device_failed == failed, "only a device that failed is checked at once"


def test_numbers_that_json_does_not_have_become_null() -> None:
    text = wire.to_text({"a": [math.inf, -math.inf, math.nan, 1.5]})
    assert json.loads(text) == {"a": [None, None, None, 1.5]}


def query(**values: object) -> Request:
    return Request({"type": "http", "query_string": urlencode(values).encode(), "headers": []})


def test_a_selection_holds_all_of_its_entries_whatever_the_usual_limit() -> None:
    numbers = list(range(1, 80))
    wanted = filter_of(query(entries=",".join(map(str, numbers))))
    assert wanted.numbers == tuple(numbers) and (wanted.limit or 0) >= len(numbers)
    assert filter_of(query()).limit == 50


@pytest.mark.parametrize("numbers", [[], [0], [-1], [True], [1.0], ["1"], 7, None, [1] * (HISTORY_LIMIT + 1)])
def test_what_is_no_list_of_numbers_selects_nothing(numbers: object) -> None:
    with pytest.raises(UsageError, match="not a list of numbers"):
        entries_of(numbers)


@pytest.mark.parametrize("limit", ["0", "-1", "1.5", "\u0665", str(HISTORY_LIMIT + 1), ""])
def test_a_limit_out_of_range_is_refused(limit: str) -> None:
    with pytest.raises(UsageError, match="limit is out of range"):
        filter_of(query(limit=limit))


def test_an_operator_that_reloads_in_time_keeps_the_lock_for_good() -> None:
    now = [0.0]
    operators = Operators(lambda: now[0])
    key = operators.join()
    assert operators.take(key)
    operators.leave(key)
    now[0] += GRACE_S - 0.1
    assert not operators.expire() and operators.taken
    assert operators.join(key) == key
    now[0] += 10 * GRACE_S
    assert not operators.expire() and operators.holds(key)
    operators.leave(key)
    now[0] += GRACE_S
    assert operators.expire() and not operators.taken
    assert operators.join(key) != key
