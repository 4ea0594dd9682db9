"""A capture that holds something in every field, variants of it, comparisons, and whole journals."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from tagid.capture import Capture, Pulse
from tagid.metadata import Ending, MotionInfo, ObjectInfo, RadarInfo, RadarSettings
from tagid.storage.journal import JournalScan, open_journal


def capture(**changes: Any) -> Capture:
    rng = np.random.default_rng(7)
    views = 9
    values: dict[str, Any] = {
        "samples": rng.integers(-(2**31), 2**31, (views, 40), dtype=np.int64).astype(np.int32),
        "range_start_m": 0.31,
        "range_step_m": 0.009149,
        "angles_rad": np.linspace(0, 6, views),
        "angle_sigma_rad": np.full(views, 1e-3),
        "axis_distance_m": 1.25,
        "antenna_height_m": 0.2,
        "antenna_separation_m": 0.15,
        "host_time_ns": 1_700_000_000_123_456_789 + np.arange(views),
        "radar_time_ms": 21.0 * np.arange(views),
        "scan_id": np.arange(70_000, 70_000 + views),
        "flags": np.arange(views, dtype=np.uint8) % 8,
        "center_frequency_hz": 4e9,
        "bandwidth_hz": 1.5e9,
        "pulse": Pulse(rng.standard_normal(31), 3.8e-12),
        "radar": RadarInfo(
            config=RadarSettings(transmit_gain=63),
            ended=Ending("sure", 0.45, "helmet-120", 5e-4, 2000),
            extra={"text": "é日本"},
        ),
        "motion": MotionInfo(nominal_rpm=2.0),
        "object": ObjectInfo(label="helmet 7"),
        "complete": False,
    }
    return Capture(**{**values, **changes})


def assert_equal(a: Capture, b: Capture) -> None:
    for field in fields(Capture):
        first, two = getattr(a, field.name), getattr(b, field.name)
        if isinstance(first, np.ndarray):
            assert first.dtype == two.dtype, field.name
            np.testing.assert_array_equal(first, two, err_msg=field.name)
        elif isinstance(first, Pulse):
            np.testing.assert_array_equal(first.samples, two.samples)
            assert first.step == two.step
        else:
            assert first == two, field.name


FLOAT = {"samples": np.linspace(-1, 1, 360, dtype=np.float32).reshape(9, 40)}


@contextmanager
def file_size_limit(most_bytes: int) -> Iterator[None]:
    """A full disk, as this process sees it."""
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


@dataclass(frozen=True)
class Journal:
    """The readable content of a journal, as `tagid.storage.journal.JournalStream` gives it."""

    header: dict[str, Any]
    scans: tuple[JournalScan, ...]
    summary: dict[str, Any] | None
    bytes_dropped: int
    motion: dict[str, Any] | None


def read_journal(path: Path) -> Journal:
    with open_journal(path) as stream:
        scans = tuple(stream.scans())
    return Journal(stream.header, scans, stream.summary, stream.bytes_dropped, stream.motion)
