"""Files of older versions and other programs, and long recordings in parts: nothing is lost or exchanged."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from tagid.errors import FileFormatError
from tagid.metadata import RadarInfo
from tagid.storage.hdf5 import write_capture
from tagid.storage.importers import read_any
from tagid.storage.journal import JournalWriter
from tagid.storage.journal_capture import write_captures
from tagid.storage.metadata import read_metadata, stored_version
from tests.unit.storage_samples import capture

DTYPES = (np.int16, np.float64, np.complex64)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("order", ["C", "F"])
def test_samples_keep_their_views_whatever_the_order_in_the_file(
    tmp_path: Path, dtype: type, order: str
) -> None:
    """MATLAB and transposed arrays are stored column by column."""
    samples = np.arange(24).reshape(4, 6).astype(dtype)
    np.savez(
        tmp_path / "a.npz", samples=np.asarray(samples, order=order), range_start_m=0.5, range_step_m=0.01,
        angles_rad=np.arange(4.0), axis_distance_m=1.5,
    )  # fmt: skip
    np.testing.assert_array_equal(read_any(tmp_path / "a.npz").samples, samples)


def test_a_coarse_radar_in_metres_is_not_taken_for_millimetres(tmp_path: Path) -> None:
    """A thousandth of 200 m is no range step of this band either."""
    np.savez(
        tmp_path / "a.npz", samples=np.ones((4, 6)), range_start_m=1e3, range_step_m=200.0,
        angles_rad=np.arange(4.0), axis_distance_m=1.5e3,
    )  # fmt: skip
    assert read_any(tmp_path / "a.npz").range_step_m == 200.0


@pytest.mark.parametrize("turns", [1, 2])
def test_degrees_are_recognised_where_they_start_again_at_zero(tmp_path: Path, turns: int) -> None:
    angles = (np.arange(0, 360 * turns, 0.5) + 100) % 360
    np.savez(
        tmp_path / "a.npz", samples=np.ones((len(angles), 6)), range_start_m=0.5, range_step_m=0.01,
        angles_rad=angles, axis_distance_m=1.5,
    )  # fmt: skip
    with pytest.raises(FileFormatError, match="not radians"):
        read_any(tmp_path / "a.npz")


def test_settings_and_facts_of_the_first_version_do_not_replace_those_in_their_place() -> None:
    assert stored_version({}, "a file without a version") == 1
    old = {
        "radar": {"config": {"base_integration_index": 11}, "base_integration_index": 7},
        "motion": {"nominal_rpm": 2.0, "rpm": 3.0, "resolved": {"period_s": 30.0}, "period_s": 20.0},
    }
    result = read_metadata(old, "a file", 1)
    assert result["radar"].config.base_integration_index == 11
    assert (result["motion"].nominal_rpm, result["motion"].resolved.period_s) == (2.0, 30.0)
    loose = {"radar": {"base_integration_index": 7}, "motion": {"rpm": 3.0, "period_s": 20.0}}
    result = read_metadata(loose, "a file", 1)
    assert result["radar"].config.base_integration_index == 7
    assert (result["motion"].nominal_rpm, result["motion"].resolved.period_s) == (3.0, 20.0)


@pytest.mark.parametrize("names", [("angle_rad",), ("angle_rad", "angles_rad"), ("angles_rad", "angle_rad")])
def test_angles_under_both_names_are_those_of_the_current_one(tmp_path: Path, names: tuple[str, ...]) -> None:
    path = tmp_path / "a.tagid.h5"
    write_capture(path, capture())
    with h5py.File(path, "r+") as file:
        angles = file["scans/angles_rad"][()]
        del file["scans/angles_rad"]
        for name in names:
            file[f"scans/{name}"] = angles + (name == "angle_rad" and len(names) > 1)
    np.testing.assert_array_equal(read_any(path).angles_rad, angles)


@pytest.mark.parametrize(("scans", "parts"), [(10, [4, 4, 2]), (8, [4, 4]), (3, [3])])
def test_the_parts_of_a_long_recording_hold_every_scan_once(
    tmp_path: Path, scans: int, parts: list[int]
) -> None:
    samples = np.arange(scans * 6, dtype=np.int32).reshape(scans, 6)
    with JournalWriter(tmp_path / "j", {"range_start_m": 0.4, "range_step_m": 0.01}) as journal:
        for number, values in enumerate(samples):
            journal.append(number, 10**18 + number, 20.0 * number, values)
        journal.close({})
    made = write_captures(
        tmp_path / "j", lambda part: tmp_path / f"{part}.tagid.h5", RadarInfo(scans_lost=5), part_bytes=4 * 24
    )
    captures = [read_any(path) for path in made.paths]
    assert [capture.views for capture in captures] == parts and made.views == scans
    np.testing.assert_array_equal(np.concatenate([capture.samples for capture in captures]), samples)
    assert len({capture.uuid for capture in captures}) == len(parts), "each is a recording of its own"
    assert all(capture.complete and capture.radar.scans_lost == 5 for capture in captures)
    positions = [capture.radar.recording for capture in captures]
    if len(parts) > 1:
        assert [(place.uuid, place.part, place.parts) for place in positions] == [
            (captures[0].uuid, number + 1, len(parts)) for number in range(len(parts))
        ]
