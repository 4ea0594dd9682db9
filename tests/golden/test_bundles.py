"""Archives of `tagid commission --bundle`: their recordings give the reported values again.

Every archive in this folder is read. Two more are made on emulated rigs, which show what an archive holds.
"""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
from pathlib import Path

import pytest

from tagid.commissioning.bench import Bench, Tape
from tagid.commissioning.bundle import write_bundle
from tagid.commissioning.rows import StepReport
from tagid.commissioning.targets import parse_target
from tagid.config import load_config
from tagid.recording.calibration import estimate_delay, reference_on, usable
from tagid.recording.inspection import inspect, turning_period
from tagid.storage.importers import read_any
from tests.measured_rig import measured_rig
from tests.target_delay import delay_ps


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundle")

    def bench(scene: str) -> Bench:
        url = f"emulator://{scene}?rig=realistic%3Fseed%3D8&seed=1"
        config = load_config({"radar.url": url, "radar.integration": 15})
        tape = {"target_distance_m": 1.0, "axis_distance_m": 1.0, "antenna_height_m": 0.05}
        return Bench(config, tape, seconds=1, scans=40)

    with measured_rig(folder, bench) as (stand, _):
        write_bundle(stand, folder / "made.zip")
    return folder / "made.zip"


def values_again(bundle: Path, folder: Path) -> dict[str, tuple[float, float, float]]:
    """Value now, value reported, and its tolerance, by name."""
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(folder)
    for line in (folder / "SHA256SUMS").read_text().splitlines():
        digest, _, name = line.partition("  ")
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest, name
    tape = Tape(**json.loads((folder / "tape.json").read_text()))
    reports = {
        step: StepReport.from_json(json.loads(path.read_text()))
        for step in ("room", "target", "turning")
        if (path := folder / f"{step}.json").exists()
    }
    results = {}
    room = read_any(folder / "room.tagid.h5")
    noise = reports["room"].values["noise_counts"]
    results["noise_counts"] = (inspect(room).noise or math.nan, noise.value, 0.05 * noise.value)
    if "target" in reports and reports["target"].values:
        target = read_any(folder / "target.tagid.h5")
        estimate = estimate_delay(target, tape.target_distance_m, tape.error_m, reference_on(room, target))
        delay = reports["target"].values["path_delay_ps"]
        base = delay_ps(parse_target(tape.target))
        results["path_delay_ps"] = (estimate.delay_ps - base, delay.value, 20.0)
    if "turning" in reports and "period_s" in reports["turning"].values:
        period = reports["turning"].values["period_s"]
        again = turning_period(read_any(folder / "turning.tagid.h5")).period_s
        results["period_s"] = (again or math.nan, period.value, max(3 * period.sigma, 1e-3 * period.value))
    return results


def test_an_archive_of_the_emulator_gives_its_values_again(made: Path, tmp_path: Path) -> None:
    result = values_again(made, tmp_path)
    assert set(result) == {"noise_counts", "path_delay_ps"}
    for name, (now, then, tolerance) in result.items():
        assert abs(now - then) <= tolerance, name


def test_an_archive_tells_neither_who_nor_when(made: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(made) as archive:
        archive.extractall(tmp_path)
        assert {"README", "SHA256SUMS", "tape.json", "link.json", "room.tagid.h5"} <= set(archive.namelist())
    capture = read_any(tmp_path / "room.tagid.h5")
    assert capture.radar.serial is None and capture.created_utc.startswith("1970")
    assert capture.host_time_ns[0] == capture.radar_time_ms[0] == 0 and len(usable(capture)) >= 30
    everything = b"".join(path.read_bytes() for path in tmp_path.iterdir())
    for word in (b"1096", b"1093", str(made.parent).encode(), b"2026-"):  # serial number, path, year
        assert word not in everything


@pytest.mark.parametrize("bundle", sorted(Path(__file__).parent.glob("*.zip")), ids=lambda path: path.name)
def test_recorded_archives_give_their_values_again(bundle: Path, tmp_path: Path) -> None:
    for name, (now, then, tolerance) in values_again(bundle, tmp_path).items():
        assert abs(now - then) <= tolerance, name
