"""An archive of a commissioning for others: recordings, tape, profile and reports, without names and times.

Serial numbers, paths, notes and host names are left out and times begin at zero; checksums and a README are
inside. `tests/golden/` reads every such archive that is put there.
"""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from tagid._version import __version__
from tagid.capture import Capture
from tagid.commissioning.bench import Bench
from tagid.commissioning.steps import MEASURING
from tagid.config import data_folder
from tagid.constants import CAPTURE_SUFFIX
from tagid.errors import ConfigError
from tagid.files import read_bytes, write_bytes
from tagid.metadata import MotionInfo, ObjectInfo, RadarInfo
from tagid.rig import Radar, installed_profile
from tagid.storage.hdf5 import write_capture

NO_TIME: Final = "1970-01-01T00:00:00+00:00"
_README: Final = """A commissioning of a radar rig, recorded by tagid {version}.

tape.json      what was measured by tape; the reference target
STEP.json      report of each step: values with standard errors, verdicts
STEP{suffix}   its recording with the radar's settings, for `tagid show` and `tagid reconstruct`
rig.toml       the profile, if the commissioning was complete
SHA256SUMS     checksums of all other files

Serial numbers, paths, notes and absolute times were removed; times begin at zero.
"""


def write_bundle(bench: Bench, path: Path) -> list[str]:
    """Write the archive; returns the names of its files.

    Raises:
        ConfigError: nothing was measured yet. StorageError, DiskFullError: files.
    """
    contents = dict(_contents(bench))
    if not any(name.endswith(CAPTURE_SUFFIX) for name in contents):
        raise ConfigError("nothing was recorded yet", "Do the first steps, then write the archive.")
    sums = "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in sorted(contents.items()))
    contents["SHA256SUMS"] = sums.encode()
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:
        for name, data in sorted(contents.items()):
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    write_bytes(path, whole.getvalue())
    return sorted(contents)


def _contents(bench: Bench) -> Iterator[tuple[str, bytes]]:
    yield "README", _README.format(version=__version__, suffix=CAPTURE_SUFFIX).encode()
    yield "tape.json", _json(asdict(bench.tape))
    for step in MEASURING:
        report = bench.report(step)
        if report is None:
            continue
        facts = {name: value for name, value in report.facts.items() if name != "serial"}
        rows = tuple(row for row in report.rows if row.name != "radar")
        yield f"{step}.json", _json(replace(report, date_utc=NO_TIME, facts=facts, rows=rows).to_json())
        if report.recording:
            yield f"{step}{CAPTURE_SUFFIX}", _capture_bytes(anonymous(bench.recording(step)))
    profile = installed_profile(data_folder())
    if profile is not None and (result := bench.report("result")) is not None and result.passed:
        import tomli_w

        radar: Radar = replace(profile.radar, serial=0)
        yield "rig.toml", tomli_w.dumps(replace(profile, radar=radar, date_utc=NO_TIME).to_toml()).encode()


def anonymous(capture: Capture) -> Capture:
    """A capture with what imaging and reading need of it, and nothing else; its times begin at zero."""
    known = capture.radar
    radar = RadarInfo(
        config=known.config,
        cable_delay_ps=known.cable_delay_ps,
        scans_lost=known.scans_lost,
        reference=known.reference,
        ended=known.ended,
    )
    url = capture.motion.url
    # The address of a device tells the computer that it was plugged into.
    motion = MotionInfo(url=url if url is not None and url.startswith("free") else None)
    host, clock = capture.host_time_ns, capture.radar_time_ms
    return replace(
        capture,
        radar=radar,
        motion=motion,
        object=ObjectInfo(),
        host_time_ns=None if host is None else host - host[0],
        radar_time_ms=None if clock is None else clock - clock[0],
        created_utc=NO_TIME,
        uuid="00000000-0000-0000-0000-000000000000",
    )


def _capture_bytes(capture: Capture) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"one{CAPTURE_SUFFIX}"
        write_capture(path, capture)
        return read_bytes(path, 1 << 30)


def _json(data: Any) -> bytes:
    return (json.dumps(data, indent=1) + "\n").encode()
