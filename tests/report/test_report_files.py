"""What a report leaves for programs, how it goes on after a stop, and what wrong input makes of it."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from report_batches import OBJECTS, a_job, lines, of_another_registry, part_of_a_turn, records_of, timeless

from tagid.batch.expected import read_manifest
from tagid.batch.inputs import Source, collect
from tagid.batch.run import FILES, Hooks
from tagid.batch.spool import FILE_NAME
from tagid.batch.watch import FolderWatch
from tagid.errors import DataError, StorageError, UsageError, visible
from tagid.report.page import PageSettings
from tagid.report.tables import CSV_COLUMNS
from tagid.storage.hdf5 import read_capture, write_capture
from tagid.storage.importers import read_any
from tagid.tags.layouts.layout import builtin_layouts


def test_each_reader_finds_its_file(make_report, captures: Path, tmp_path: Path) -> None:
    out = tmp_path / "report"
    seen: list[int] = []
    finished = make_report(
        captures, hooks=Hooks(lambda done, of, rate, remaining: seen.append(len(lines(out))))
    )
    assert seen[:-1] == [1, 2, 3, 4], "results can be followed while the run goes on"
    assert {path.name for path in out.iterdir()} == {*FILES, FILE_NAME}
    assert finished.exit_code == 5
    records = records_of(out)
    assert records["helmet-120.tagid.h5"]["layout"] == "helmet-120"
    assert records["empty.tagid.h5"]["status"] == "no_tag"
    assert records["bad.tagid.h5"]["error"]["code"] == "bad_file"
    assert {record["schema_version"] for record in records.values()} == {1}
    assert "notes.txt" not in records

    with (out / "items.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert len(rows) == 5
    for row in rows:
        record = records[Path(row["file"]).name]
        assert row["status"] == record["status"]
        if record["centre_m"]:
            assert float(row["centre_x_m"]) == record["centre_m"][0]

    suite = ET.parse(out / "junit.xml").getroot().find("testsuite")
    assert suite is not None
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("5", "1", "1")
    assert len(suite.findall("testcase")) == 5
    assert len(suite.findall("testcase/error")) == len(suite.findall("testcase/failure")) == 1

    summary = json.loads((out / "summary.json").read_text())
    assert summary["by_status"] == {
        "identified": 3, "unknown": 0, "ambiguous": 0, "no_tag": 1, "failed": 1
    }  # fmt: skip
    assert summary["complete"] is True
    assert summary["passed_over"]["count"] == 1


def test_expectations_are_scored(make_report, captures: Path, tmp_path: Path) -> None:
    manifest = tmp_path / "m.csv"
    manifest.write_text(
        "File;Expected layout\ncaptures/helmet-120.tagid.h5;helmet-120\n"
        "container-90.tagid.h5;container-180\ncaptures/empty.tagid.h5;no_tag\n"
        f"{captures / 'bad.tagid.h5'};container-180\n"
    )
    names = list(builtin_layouts())
    expectations = read_manifest(manifest, collect([str(captures)]).sources, names)
    finished = make_report(captures, expectations=expectations)
    expected = finished.summary["expected"]
    assert (expected["items"], expected["correct"], expected["not_in_manifest"]) == (4, 2, 1)
    assert expected["accuracy"] == 0.5
    matrix = expected["confusion"]
    row = matrix["counts"][matrix["expected"].index("container-180")]
    assert row[matrix["answers"].index("container-90")] == 1
    assert sum(map(sum, matrix["counts"])) == 4
    assert [Path(miss["file"]).name for miss in expected["misses"]] == [
        "bad.tagid.h5", "container-90.tagid.h5"
    ]  # fmt: skip
    suite = ET.parse(tmp_path / "report" / "junit.xml").getroot().find("testsuite")
    assert suite is not None
    # The one without an expectation passes because it is identified, the empty one because that was expected.
    assert (suite.get("failures"), suite.get("errors")) == ("1", "1")
    page = (tmp_path / "report" / "report.html").read_text()
    assert "50.0" in page and "Confusion matrix" in page


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,expected_layout\nnone.tagid.h5,helmet-120\n", "not among the inputs: line 2: none.tagid.h5"),
        ("helmet-120.tagid.h5,helmet-999\n", "not enrolled: line 1: 'helmet-999'"),
        ("helmet-120.tagid.h5,helmet-120\nhelmet-120.tagid.h5,container-90\n", "different answers"),
        ("", "is empty"),
        ("helmet-120.tagid.h5\n", "line 1: a file and its expected layout"),
    ],
)
def test_a_manifest_that_does_not_fit_ends_before_the_start(captures: Path, tmp_path, text, message) -> None:
    manifest = tmp_path / "m.csv"
    manifest.write_text(text)
    with pytest.raises(UsageError, match=message):
        read_manifest(manifest, collect([str(captures)]).sources, ["helmet-120", "container-90"])


def test_resume_redoes_only_what_changed(make_report, captures: Path, tmp_path: Path, job) -> None:
    make_report(captures)
    before = {record["file"]: record for record in lines(tmp_path / "report")}
    shutil.copy(captures / "empty.tagid.h5", captures / "renamed.tagid.h5")
    (captures / "container-90.tagid.h5").write_bytes((captures / "helmet-120.tagid.h5").read_bytes())
    again = make_report(captures, resume=True)
    assert again.reused == 6, "every content had been seen"
    after = {record["file"]: record for record in lines(tmp_path / "report")}
    assert after[str(captures / "container-90.tagid.h5")]["layout"] == "helmet-120"
    assert after[str(captures / "renamed.tagid.h5")]["status"] == "no_tag"
    unchanged = str(captures / "container-180.tagid.h5")
    assert after[unchanged] == before[unchanged], "the very answer of the first run, its timings included"
    # Other settings are another question.
    assert make_report(captures, resume=True, job=of_another_registry(job)).reused == 0
    # Without --resume all is new.
    assert make_report(captures).reused == 0


def test_a_stopped_run_leaves_a_report_and_goes_on(make_report, captures: Path, tmp_path: Path) -> None:
    asked = iter([False, True])
    part = make_report(captures, hooks=Hooks(stopped=lambda: next(asked)))
    assert part.interrupted and not part.summary["complete"]
    assert len(lines(tmp_path / "report")) == 2
    assert "Partial report: 2 of 5" in (tmp_path / "report" / "report.html").read_text()
    ET.parse(tmp_path / "report" / "junit.xml")
    rest = make_report(captures, resume=True)
    assert (rest.reused, rest.summary["complete"]) == (2, True)
    assert len(lines(tmp_path / "report")) == 5


def test_fail_fast_stops_at_the_first_failure(make_report, captures: Path, tmp_path: Path) -> None:
    finished = make_report(captures, fail_fast=True)
    assert finished.exit_code == 5
    assert [Path(r["file"]).name for r in lines(tmp_path / "report")] == ["bad.tagid.h5"]
    assert not finished.summary["complete"]


def test_one_uuid_in_two_files_is_told(make_report, captures: Path, recorded: Path) -> None:
    first = read_capture(captures / "empty.tagid.h5")
    write_capture(captures / "other.tagid.h5", replace(first, object=replace(first.object, note="again")))
    shutil.copy(captures / "helmet-120.tagid.h5", captures / "copy.tagid.h5")
    twins = {d["capture_uuid"]: d["same_content"] for d in make_report(captures).summary["duplicate_uuids"]}
    assert len(twins) == 2
    assert twins[first.uuid] is False


def test_what_qualifies_an_answer_reaches_every_file(make_report, captures: Path, tmp_path: Path) -> None:
    part_of_a_turn(captures / "helmet-120.tagid.h5", captures / "part.tagid.h5", 0.75)
    part_of_a_turn(captures / "helmet-120.tagid.h5", captures / "quarter.tagid.h5", 0.4)
    shutil.copy(captures / "part.tagid.h5", captures / "part-copy.tagid.h5")
    (captures / "lost.tagid.h5").symlink_to("nowhere.tagid.h5")
    summary = make_report(captures).summary
    assert (summary["items"], summary["captures"], summary["copies"]) == (8, 7, 1)
    assert sum(summary["by_status"].values()) == 7 and summary["by_layout"]["helmet-120"] == 2
    assert summary["caveats"]["part_of_a_turn"] == 2 and summary["caveats"]["no_bound"] >= 1
    assert summary["dangling_links"] == [str(captures / "lost.tagid.h5")]
    out = tmp_path / "report"
    records = records_of(out)
    with (out / "items.csv").open(newline="") as file:
        rows = {Path(row["file"]).name: row for row in csv.DictReader(file)}
    cases = {
        Path(case.get("name", "")).name: "".join(text.text or "" for text in case.iter("system-out"))
        for case in ET.parse(out / "junit.xml").getroot().iter("testcase")
    }

    record, row, case = (of["part.tagid.h5"] for of in (records, rows, cases))
    assert (record["status"], record["bound"]) == ("identified", None) and record["coverage"] < 0.8
    assert (row["caveats"], row["bound_p_value"]) == ("part of a turn; no bound", "")
    assert float(row["coverage"]) == record["coverage"]
    assert row["copy_of"] == record["copy_of"] == str(captures / "part-copy.tagid.h5")
    assert record["recorded_utc"] == row["recorded_utc"] == "2026-11-03T07:15:30.000+00:00"
    assert record["recording_note"] == row["recording_note"] == "table stopped"
    for words in ("part of a turn: ", "no bound: it holds for whole turns", "table stopped", "07:15:30 UTC"):
        assert words in case

    record, row, case = (of["quarter.tagid.h5"] for of in (records, rows, cases))
    assert record["status"] == "unknown" and row["caveats"] == "part of a turn"
    assert row["what_to_do"] == record["causes"][0]["remedy"] and f"what to do: {row['what_to_do']}" in case
    assert record["reason_code"] == record["causes"][0]["code"] == "partial_turn"
    assert rows["helmet-120.tagid.h5"]["copy_of"] == "" and records["empty.tagid.h5"]["copy_of"] is None
    page = (out / "report.html").read_text()
    assert "2 of a part of a turn, " in page and "1 copy not counted" in page and "lost.tagid.h5" in page
    # Settings are words: no dict, None or True of Python.
    facts = page[page.index("provenance-head") :].partition("</section>")[0]
    assert "extent, m" in facts and not re.search(r"\b(None|True|False)\b|[{}]", facts)


def test_a_copy_counts_for_what_is_expected_of_it(make_report, captures: Path, tmp_path: Path) -> None:
    shutil.copy(captures / "empty.tagid.h5", captures / "twin.tagid.h5")
    manifest = tmp_path / "m.csv"
    names = list(builtin_layouts())

    def compared(text: str) -> tuple[int, int]:
        manifest.write_text(text)
        wanted = read_manifest(manifest, collect([str(captures)]).sources, names)
        expected = make_report(captures, expectations=wanted, resume=True).summary["expected"]
        return expected["items"], expected["correct"]

    assert compared("empty.tagid.h5,no_tag\ntwin.tagid.h5,no_tag\n") == (1, 1)
    assert compared("empty.tagid.h5,no_tag\ntwin.tagid.h5,helmet-120\n") == (2, 1)
    assert compared("twin.tagid.h5,helmet-120\n") == (1, 0)


def test_names_that_are_no_text_and_hostile_ones(make_report, captures: Path, tmp_path: Path) -> None:
    source = captures / "empty.tagid.h5"
    latin = Path(os.fsdecode(os.fsencode(captures) + b"/caf\xe9.tagid.h5"))
    hostile = captures / '<script>x</script & "q" \x1b\n.tagid.h5'.replace("/", "\u2215")
    for name in (latin, hostile):
        shutil.copy(source, name)
    make_report(captures)
    out = tmp_path / "report"
    names = [record["file"] for record in lines(out)]
    assert f"{captures}/caf\\xe9.tagid.h5" in names
    cases = [case.get("name") for case in ET.parse(out / "junit.xml").getroot().iter("testcase")]
    assert any(name and "caf\\xe9" in name for name in cases)
    assert any(name and "<script>" in name and "\n" in name and "\x1b" not in name for name in cases)
    with (out / "items.csv").open(newline="") as file:
        # Control characters are written out: a spreadsheet or a terminal must not act on them.
        assert sorted(row["file"] for row in csv.DictReader(file)) == sorted(map(visible, names))
    page = (out / "report.html").read_text()
    assert "<script>x" not in page
    # The same content under two more names is the same capture.
    assert make_report(captures, resume=True).reused == len(names)


def test_places_that_hold_nothing_or_cannot_be_read(make_report, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(DataError, match="no captures in"):
        make_report(empty)
    (empty / "lost.tagid.h5").symlink_to("nowhere")
    with pytest.raises(DataError, match=r"lost\.tagid\.h5: a link to a file that does not exist"):
        make_report(empty)
    (empty / "notes.txt").write_text("x")
    with pytest.raises(DataError, match="1 other file"):
        make_report(empty)
    with pytest.raises(StorageError, match="no such file or folder"):
        make_report(tmp_path / "none")
    (empty / "a.npz").write_bytes(b"x")
    with pytest.raises(StorageError, match=r"not a folder|exists"):
        make_report(empty, out=empty / "a.npz")
    assert not (tmp_path / "report").exists()


def test_closed_folders_and_files(make_report, recorded: Path) -> None:
    # The superuser may read everything, so the test looks with another user's rights.
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        captures = place / "captures"
        closed = captures / "closed"
        closed.mkdir(parents=True)
        shutil.copy(recorded / "helmet-120.tagid.h5", captures)
        for folder in (place, captures):
            folder.chmod(0o777)
        (captures / "helmet-120.tagid.h5").chmod(0)
        closed.chmod(0)
        was = os.geteuid()
        if was == 0:
            os.seteuid(65534)
        try:
            finished = make_report(captures, out=place / "report")
            with pytest.raises(StorageError, match="no permission"):
                make_report(closed, out=place / "report")
        finally:
            os.seteuid(was)
            closed.chmod(0o700)
        (record,) = [r for r in lines(place / "report") if "helmet-120" in r["file"]]
        assert record["error"]["code"] == "storage"
        assert "no permission" in record["error"]["message"]
        assert finished.summary["by_status"]["failed"] == 1
        assert finished.summary["unreadable_folders"][0].startswith(str(closed))


def test_a_disk_that_fills_up_leaves_the_old_page(make_report, captures: Path, tmp_path: Path) -> None:
    make_report(captures)
    page = tmp_path / "report" / "report.html"
    before = page.read_bytes()
    code = (
        "import resource, sys\nfrom dataclasses import replace\nfrom pathlib import Path\n"
        "from tagid.batch.spool import Spool\nfrom tagid.errors import DiskFullError\n"
        "from tagid.report.page import PageSettings, write_page\n"
        "import json\nout = Path(sys.argv[1])\n"
        "with Spool(out / '.tagid-report.sqlite', fresh=False) as spool:\n"
        f"    resource.setrlimit(resource.RLIMIT_FSIZE, ({len(before) // 2},) * 2)\n"
        "    summary = json.loads((out / 'summary.json').read_text())\n"
        "    items = lambda: (replace(item, record=item.record.judged(None)) for item in spool.items())\n"
        "    try: write_page(out / 'report.html', items, spool.pictures, summary, PageSettings('new'))\n"
        "    except DiskFullError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(page.parent)], capture_output=True, text=True, check=True
    )
    assert "disk is full" in done.stdout
    assert page.read_bytes() == before
    assert {path.name for path in page.parent.iterdir()} == {*FILES, FILE_NAME}


def test_pictures_share_a_budget(make_report, captures: Path, tmp_path: Path) -> None:
    page = tmp_path / "report" / "report.html"

    def pictures(megabytes: float) -> dict[str, int]:
        job = a_job(pictures=True)
        make_report(captures, page=PageSettings(megabytes=megabytes), resume=True, job=job)
        result = re.findall(r'type="text/plain" id="(\w+)">([^<]*)<', page.read_text())
        return {name: len(text) for name, text in result}

    everything = pictures(1.0)
    assert len(everything) == 8, "image and sinogram of the four that could be read"
    budget = sum(everything.values()) * 0.6
    some = pictures(budget / 1e6)
    assert budget * 0.5 < sum(some.values()) <= budget
    # The one without a tag is looked at first and keeps its sinogram; others have a small image only.
    kinds = [{name[0] for name in some if name[1:] == position} for position in "1234"]
    assert kinds[2] == {"i", "s"}
    assert {"i"} in kinds
    assert pictures(0.0) == {}


def test_the_same_file_by_url_is_the_same_answer(make_report, captures: Path, tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    make_report(captures)
    plain = [timeless(r) for r in lines(tmp_path / "report")]
    finished = make_report(f"file://{captures}", out=tmp_path / "by-url")
    assert finished.exit_code == 5
    by_url = [timeless(r) for r in lines(tmp_path / "by-url")]
    for first, other in zip(plain, by_url, strict=True):
        assert other["file"] == f"file://{first['file']}"
        for record in (first, other):
            record.pop("file")
            record["reason"] = record["reason"].replace("file://", "")
            if record["error"]:
                record["error"]["message"] = record["error"]["message"].replace("file://", "")
    assert by_url == plain


def test_a_watched_folder_gives_each_file_once_it_is_complete(captures: Path, tmp_path: Path) -> None:
    watch = FolderWatch(captures, interval_s=0.0)
    arrivals = watch.arrivals([Source.of(str(captures / "bad.tagid.h5"))])

    def arrive(count: int) -> list[str]:
        results: list[str] = []
        while len(results) < count:
            source = next(arrivals)
            if source is not None:
                results.append(Path(source.location).name)
        return results

    assert arrive(4) == [f"{name}.tagid.h5" for name in sorted(OBJECTS)]
    growing = captures / "late.tagid.h5"
    whole = (captures / "empty.tagid.h5").read_bytes()
    growing.write_bytes(whole[:100])
    assert [next(arrivals), next(arrivals)] == [None, None], "one look does not tell that it is complete"
    growing.write_bytes(whole)
    assert arrive(1) == ["late.tagid.h5"]


def test_an_npz_without_a_uuid_is_the_same_capture_each_time(tmp_path: Path) -> None:
    values = {
        "range_start_m": 0.3,
        "range_step_m": 0.009,
        "axis_distance_m": 1.0,
        "angles_rad": np.arange(9.0),
    }
    rng = np.random.default_rng(0)
    for name in "ab":
        np.savez(tmp_path / f"{name}.npz", samples=rng.standard_normal((9, 40)).astype(np.float32), **values)
    uuids = [read_any(tmp_path / f"{name}.npz").uuid for name in "aab"]
    assert uuids[0] == uuids[1] != uuids[2]
