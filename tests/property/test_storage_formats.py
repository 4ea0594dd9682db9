"""Any capture comes back equal from each lossless format, and any scans from a journal."""

from __future__ import annotations

import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from tagid.capture import Capture, Pulse
from tagid.metadata import MotionInfo, ObjectInfo, RadarInfo, RadarSettings, ResolvedMotion, ScanGap, Track
from tagid.storage.exporters import export
from tagid.storage.importers import read_any
from tagid.storage.journal import JournalWriter
from tagid.storage.recordings import encode_recording
from tests.unit.storage_samples import read_journal

NUMBER = st.floats(-1e7, 1e7)
POSITIVE = st.floats(1.0, 1e4)
INT64 = st.integers(-(2**63), 2**63 - 1)
NAMES = {
    field.name
    for kind in (RadarInfo, RadarSettings, MotionInfo, ResolvedMotion, ObjectInfo)
    for field in fields(kind)
}
JSON = st.dictionaries(
    st.text(max_size=9).filter(lambda key: key not in NAMES),
    st.recursive(
        st.none() | st.booleans() | INT64 | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=6,
    ),
    max_size=4,
)


TEXT = st.none() | st.text(max_size=9)
WHOLE = st.none() | st.integers(-(2**40), 2**40)
REAL = st.none() | st.floats(-1e9, 1e9)
GAPS = st.lists(st.builds(ScanGap, st.integers(0, 99), st.floats(0, 9), st.text(max_size=5), st.booleans()))
SETTINGS = st.builds(RadarSettings, scan_start_ps=WHOLE, transmit_gain=WHOLE, extra=JSON)
RADAR = st.builds(
    RadarInfo, source=TEXT, serial=TEXT | WHOLE, config=st.none() | SETTINGS, cable_delay_ps=REAL,
    statistics=st.none() | st.dictionaries(st.text(max_size=5), st.integers(0, 99)),
    gaps=GAPS.map(tuple), window_actual_ps=st.none() | st.tuples(st.integers(), st.integers()), extra=JSON,
)  # fmt: skip
RESOLVED = st.builds(
    ResolvedMotion, kind=TEXT, period_s=REAL, harmonic_ambiguous=st.none() | st.booleans(),
    unexplained=st.none() | st.dictionaries(st.text(max_size=3), st.floats(0, 1)), extra=JSON,
)  # fmt: skip
TRACK = st.lists(st.tuples(INT64, st.floats(-9, 9), st.floats(0, 1)), max_size=3).map(
    lambda readings: Track.of(readings, {"kind": "roomba"})
)
MOTION = st.builds(
    MotionInfo, url=TEXT, nominal_rpm=REAL, resolved=st.none() | RESOLVED, track=st.none() | TRACK, extra=JSON
)
OBJECT = st.builds(ObjectInfo, label=TEXT, note=TEXT, demo=st.none() | st.booleans(), extra=JSON)
"""Metadata with fields that are known and keys that no field has."""


@st.composite
def captures(draw: st.DrawFn) -> Capture:
    """Captures of a few views, each optional field there or not."""
    views, bins = draw(st.integers(1, 5)), draw(st.integers(1, 9))
    dtype = draw(st.sampled_from(["int32", "float32", "complex64"]))
    real = st.floats(width=32, allow_nan=False, allow_infinity=False)
    elements = {
        "int32": st.integers(-(2**31), 2**31 - 1),
        "float32": real,
        "complex64": st.builds(complex, real, real),
    }[dtype]

    def vector(kind: str, values: st.SearchStrategy[Any]) -> Any:
        return draw(st.none() | npst.arrays(kind, views, elements=values))

    place = draw(st.sampled_from(["angles", "positions", "neither"]))
    positions = npst.arrays("float64", (views, 3), elements=NUMBER)
    pulse = draw(st.none() | npst.arrays("float64", st.integers(2, 9), elements=st.floats(0.5, 2)))
    return Capture(
        samples=draw(npst.arrays(dtype, (views, bins), elements=elements)),
        range_start_m=draw(NUMBER),
        range_step_m=draw(POSITIVE),
        angles_rad=draw(npst.arrays("float64", views, elements=NUMBER)) if place == "angles" else None,
        angle_sigma_rad=vector("float64", NUMBER),
        axis_distance_m=draw(st.none() | POSITIVE),
        antenna_height_m=draw(NUMBER),
        antenna_separation_m=draw(st.floats(0, 10)),
        antenna_positions_m=draw(positions) if place == "positions" else None,
        receive_positions_m=draw(st.none() | positions) if place == "positions" else None,
        host_time_ns=vector("int64", INT64),
        radar_time_ms=vector("float64", NUMBER),
        scan_id=vector("int64", INT64),
        flags=vector("uint8", st.integers(0, 255)),
        center_frequency_hz=draw(POSITIVE),
        bandwidth_hz=draw(POSITIVE),
        pulse=None if pulse is None else Pulse(pulse, draw(st.floats(1e-15, 1.0))),
        radar=draw(RADAR),
        motion=draw(MOTION),
        object=draw(OBJECT),
        complete=draw(st.booleans()),
    )


def comparable(capture: Capture) -> list[Any]:
    """Every field as plain values that compare bit for bit."""
    values: list[Any] = []
    for field in fields(Capture):
        value = getattr(capture, field.name)
        if isinstance(value, Pulse):
            value = (value.samples.tobytes(), value.step)
        if isinstance(value, np.ndarray):
            value = (str(value.dtype), value.shape, value.tobytes())
        values.append((field.name, value))
    return values


@given(captures())
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_round_trip(capture: Capture) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name in ("a.npz", "a.mat", "a.tagid.h5"):
            export(capture, Path(folder) / name)
            assert comparable(read_any(Path(folder) / name)) == comparable(capture), name
        assert len(list(Path(folder).iterdir())) == 3


@given(*(st.integers(*span) for span in ((1, 6), (1, 1100), (0, 65_535), (0, 2**32 - 1), (0, 2**31 - 10**6))))
@settings(max_examples=40, deadline=None)
def test_recording_written_and_read_and_written(
    views: int, bins: int, first_id: int, first_ms: int, start_ps: int
) -> None:
    capture = Capture(
        np.random.default_rng(bins).integers(-(2**31), 2**31, (views, bins)).astype(np.int32),
        0.0,
        0.01,
        scan_id=first_id + np.arange(views),
        radar_time_ms=first_ms + 22.0 * np.arange(views),
        radar=RadarInfo(config=RadarSettings(scan_start_ps=start_ps, scan_stop_ps=start_ps + 1000)),
    )
    data = encode_recording(capture)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.out"
        path.write_bytes(data)
        again = read_any(path)
    np.testing.assert_array_equal(again.samples, capture.samples)
    np.testing.assert_array_equal(again.scan_id, capture.scan_id)
    np.testing.assert_array_equal(again.radar_time_ms, capture.radar_time_ms)
    assert encode_recording(again) == data


HEADER = {"range_start_m": 0.0, "range_step_m": 0.01}
FINITE = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def recordings(draw: st.DrawFn) -> list[tuple[Any, ...]]:
    """Scans of one length and dtype, with any numbers and times."""
    dtype = draw(st.sampled_from(["int32", "float32", ">i4"]))
    bins = draw(st.integers(1, 40))
    values = None if dtype != "float32" else st.floats(width=32, allow_nan=False)
    samples = npst.arrays(dtype, bins, elements=values)
    single = st.tuples(INT64, INT64, FINITE, samples, st.integers(0, 255))
    return draw(st.lists(single, max_size=6))


SUMMARY = st.dictionaries(
    st.text(max_size=9), st.none() | st.booleans() | INT64 | FINITE | st.text(), max_size=4
)


@given(recordings(), st.none() | SUMMARY)
@settings(max_examples=60, deadline=None)
def test_journal_round_trip(scans: list[tuple[Any, ...]], summary: dict[str, Any] | None) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "j"
        with JournalWriter(path, HEADER, sync_every=0) as journal:
            for scan in scans:
                journal.append(*scan)
            if summary is not None:
                journal.close(summary)
        stored = read_journal(path)
    assert stored.header == HEADER and stored.summary == summary and stored.bytes_dropped == 0
    for scan, (number, host_ns, radar_ms, samples, flags) in zip(stored.scans, scans, strict=True):
        assert (scan.scan_id, scan.host_time_ns, scan.radar_time_ms) == (number, host_ns, radar_ms)
        assert scan.flags == flags and np.array_equal(scan.samples, samples)
