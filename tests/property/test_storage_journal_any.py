"""For any scans and any damage: what the journal gives back is what was appended, and nothing else."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from tagid.errors import FileFormatError
from tagid.storage.journal import JournalScan, JournalWriter
from tests.unit.storage_samples import read_journal

HEADER = {"range_start_m": 0.0, "range_step_m": 0.01}
INT64 = st.integers(-(2**63), 2**63 - 1)
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


def write(folder: str, scans: list[tuple[Any, ...]], summary: dict[str, Any] | None) -> Path:
    path = Path(folder) / "j"
    with JournalWriter(path, HEADER, sync_every=0) as journal:
        for scan in scans:
            journal.append(*scan)
        if summary is not None:
            journal.close(summary)
    return path


def is_same(scan: JournalScan, truth: tuple[Any, ...]) -> bool:
    return (scan.scan_id, scan.host_time_ns, scan.radar_time_ms, scan.flags) == (
        truth[0],
        truth[1],
        truth[2],
        truth[4],
    ) and np.array_equal(scan.samples, truth[3])


JSON = st.dictionaries(
    st.text(max_size=9), st.none() | st.booleans() | INT64 | FINITE | st.text(), max_size=4
)


@given(recordings(), st.none() | JSON)
@settings(max_examples=60, deadline=None)
def test_round_trip(scans: list[tuple[Any, ...]], summary: dict[str, Any] | None) -> None:
    with tempfile.TemporaryDirectory() as folder:
        journal = read_journal(write(folder, scans, summary))
    assert journal.header == HEADER and journal.summary == summary and journal.bytes_dropped == 0
    assert len(journal.scans) == len(scans)
    assert all(map(is_same, journal.scans, scans))


@given(recordings(), st.lists(st.tuples(st.integers(0, 10**6), st.integers(1, 255)), max_size=4), st.data())
@settings(max_examples=80, deadline=None)
def test_damage_loses_scans_but_never_changes_one(
    scans: list[tuple[Any, ...]], flips: list[tuple[int, int]], data: st.DataObject
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = write(folder, scans, {})
        content = bytearray(path.read_bytes())
        for position, bits in flips:
            content[position % len(content)] ^= bits
        path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
        try:
            journal = read_journal(path)
        except FileFormatError:
            return
    rest = iter(scans)
    assert all(any(is_same(scan, truth) for truth in rest) for scan in journal.scans)
