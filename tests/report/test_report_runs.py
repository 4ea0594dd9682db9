"""`tagid report` and `tagid history` as processes: stopped, killed, several at once."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from report_batches import OBJECTS, a_job, keep, lines

from tagid.batch.inputs import Source
from tagid.batch.local import Task, run_local
from tagid.batch.run import FILES
from tagid.cli.app import app
from tagid.cli.frame import serve
from tests.processes import TAGID, wait_until


def many(captures: Path, count: int) -> None:
    for number in range(count):
        shutil.copy(captures / "container-90.tagid.h5", captures / f"more-{number:02d}.tagid.h5")


def start(home: dict[str, str], folder: Path, *words: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*TAGID, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env=home,
        start_new_session=True,  # a process group of its own, as a terminal gives it
    )


def test_the_whole_way(tagid, captures: Path, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("file,expected_layout\nhelmet-120.tagid.h5,helmet-120\n")
    done = tagid("report", "captures", "--out", "r", "--expect", "m.csv", "--jobs", 2, "--output", "json")
    assert done.code == 5
    document = done.json
    assert (document["command"], document["status"], document["exit_code"]) == ("report", "partial", 5)
    status = {item["file"].rpartition("/")[2]: item["status"] for item in document["data"]["items"]}
    answers = {"bad": "failed", "empty": "no_tag"}
    expected = {name: answers.get(name, "identified") for name in ("bad", *OBJECTS)}
    assert status == {f"{name}.tagid.h5": answer for name, answer in expected.items()}
    assert document["errors"][0]["code"] == "bad_file"
    assert document["data"]["summary"]["expected"]["accuracy"] == 1.0
    assert "5/5" in done.err, "progress"
    assert all((tmp_path / "r" / name).exists() for name in FILES)
    (captures / "bad.tagid.h5").unlink()
    assert tagid("report", "captures", "--out", "r", "--resume", "-q").code == 3
    (captures / "empty.tagid.h5").unlink()
    fine = tagid("report", "captures", "--out", "r", "--resume")
    assert fine.code == 0
    assert "no longer in its place: 1 capture of the earlier report" in fine.err
    assert "3 captures: 3 identified" in fine.out
    assert "reused from the earlier run: 3 answers" in fine.err

    # Every answer was kept once, and reused answers not again.
    rows = tagid("history", "--output", "json").json["data"]["items"]
    assert len(rows) == 5
    assert {row["command"] for row in rows} == {"report"}
    table = list(csv.DictReader(io.StringIO(tagid("history", "--output", "csv", "--status", "no_tag").out)))
    assert [Path(row["file"]).name for row in table] == ["empty.tagid.h5"]

    # An earlier report is replaced, and one of other captures continued, only on request.
    (tmp_path / "other").mkdir()
    shutil.copy(captures / "helmet-120.tagid.h5", tmp_path / "other")
    for words in ((), ("--resume",)):
        refused = tagid("report", "other", "--out", "r", *words)
        assert refused.code == 1 and "--force" in refused.err
        assert "r holds a report of 3 captures" in refused.err
    assert "not among the inputs: 3, e.g. captures/container-180.tagid.h5" in refused.err
    assert len(lines(tmp_path / "r")) == 3
    assert tagid("report", str(captures), "--out", "r", "--resume", "-j", 1).code == 0, "another path"


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("report",), 2, "nothing to identify"),
        (("report", "nothing-here"), 1, "no captures in nothing-here"),
        (("report", "captures", "--jobs", -1), 2, "--jobs is -1"),
        (("report", "captures", "--expect", "captures/notes.txt"), 2, "a file and its expected layout"),
        (("report", "captures", "--page-megabytes", -1), 2, "picture limit"),
        (("report", "--watch", "captures/notes.txt"), 2, "is not a folder"),
        (("history", "export"), 2, "export needs a file"),
        (("history", "export", "a.xls"), 2, "format"),
        (("history", "--since", "yesterday"), 2, "not a date"),
        (("history", "--status", "fine"), 2, "unknown status 'fine'"),
    ],
)
def test_wrong_command_lines(
    captures: Path, tmp_path: Path, home, monkeypatch: pytest.MonkeyPatch, capsys, words, code, message
) -> None:
    (tmp_path / "nothing-here").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["tagid", *map(str, words)])
    for name in ("TAGID_DATA", "TAGID_CONFIG", "COLUMNS"):
        monkeypatch.setenv(name, home[name])
    ended = serve(app)
    err = capsys.readouterr().err
    assert (ended, err.count("error:")) == (code, 1), err
    assert message in " ".join(err.split())
    assert not (tmp_path / "report").exists()


def test_ctrl_c_leaves_a_report_and_resume_goes_on(home, tagid, captures: Path, tmp_path: Path) -> None:
    many(captures, 30)
    process = start(home, tmp_path, "report", "captures", "--out", "r", "-j", 2)

    def begun() -> bool:
        """Three answers are there, and that of the capture of which there are copies."""
        results = [Path(line["file"]).name for line in lines(tmp_path / "r")]
        return len(results) >= 3 and any(name.startswith(("container-90", "more-")) for name in results)

    wait_until(begun, process)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert "--resume" in err
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert summary["interrupted"] and not summary["complete"]
    assert 3 <= summary["items"] < 35
    assert len(lines(tmp_path / "r")) == summary["items"]
    rest = tagid("report", "captures", "--out", "r", "--resume", "--output", "json")
    assert len(rest.json["data"]["items"]) == 35
    assert rest.json["data"]["summary"]["reused"] >= 30, "copies of one capture are one content"


def test_a_killed_run_goes_on_where_it_was(home, tagid, captures: Path, tmp_path: Path) -> None:
    keep(captures, "bad", "empty", "helmet-120")
    process = start(home, tmp_path, "report", "captures", "--out", "r", "-j", 1)
    wait_until(lambda: len(lines(tmp_path / "r")) >= 2, process)
    process.kill()
    process.communicate()
    rest = tagid("report", "captures", "--out", "r", "--resume", "--output", "json")
    assert rest.json["data"]["summary"]["reused"] >= 2
    assert len(rest.json["data"]["items"]) == 3


def test_a_watched_folder(home, tagid, captures: Path, recorded: Path, tmp_path: Path) -> None:
    (tmp_path / "drop").mkdir()
    words = ("report", "--watch", "drop", "--out", "drop/report", "-j", 1)
    process = start(home, tmp_path, *words)
    out = tmp_path / "drop" / "report"
    shutil.copy(captures / "helmet-120.tagid.h5", tmp_path / "drop")
    wait_until(lambda: len(lines(out)) == 1 and (out / "report.html").exists(), process)
    shutil.copy(captures / "empty.tagid.h5", tmp_path / "drop")
    summary = out / "summary.json"
    wait_until(lambda: summary.exists() and '"items": 2' in summary.read_text(), process)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert re.search(r"^drop/helmet-120.tagid.h5: helmet-120(, no bound)?, [\d.]+ s$", err, re.MULTILINE)
    assert re.search(r"^drop/empty.tagid.h5: no tag, [\d.]+ s$", err, re.MULTILINE)
    assert [Path(r["file"]).name for r in lines(out)] == ["helmet-120.tagid.h5", "empty.tagid.h5"]
    assert tagid(*words, "--resume", "--idle-stop", 2).code == 3


def test_scans_and_a_report_at_once_lose_nothing(home, tagid, captures: Path, tmp_path: Path) -> None:
    tagid("layouts")
    keep(captures, "bad", "empty")
    scan = ("scan", "--radar", "emulator://helmet-120", "--axis-distance", 1, "--scans", 60, "--save-dir")
    processes = [
        start(home, tmp_path, "report", "captures", "--out", "r", "-j", 1),
        start(home, tmp_path, *scan, "a"),
        start(home, tmp_path, *scan, "b"),
    ]
    for process in processes:
        _, err = process.communicate(timeout=120)
        assert "not stored in the history" not in err
        assert process.returncode in (0, 1, 3, 5), err
    rows = tagid("history", "--output", "json").json["data"]["items"]
    assert sorted(row["command"] for row in rows) == ["report"] * 2 + ["scan"] * 2
    kept = {Path(row["file"]).name for row in rows if row["command"] == "report"}
    assert kept == {Path(record["file"]).name for record in lines(tmp_path / "r")}


def test_a_worker_that_dies_costs_its_item_only(
    make_report, captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep(captures, "bad", "container-180", "empty")
    # A file whose reading ends the process, as a fault in native code would.
    (tmp_path / "sitecustomize.py").write_text(
        "import os\nfrom tagid.batch import work\ncopy = work.local_copy\n"
        "def local_copy(source):\n    if source.name.endswith('bad.tagid.h5'): os._exit(9)\n"
        "    return copy(source)\nwork.local_copy = local_copy\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    finished = make_report(captures, runner=partial(run_local, workers=2))
    assert finished.summary["by_status"] == {
        "identified": 1, "unknown": 0, "ambiguous": 0, "no_tag": 1, "failed": 1
    }  # fmt: skip
    (dead,) = (record for record in lines(tmp_path / "report") if record["status"] == "failed")
    assert dead["file"].endswith("bad.tagid.h5")
    assert "died" in dead["error"]["message"]


def test_one_thread_each_and_tasks_only_as_needed(captures: Path) -> None:
    taken = []

    def tasks():
        for number in range(100):
            taken.append(number)
            yield Task(number, Source.of(str(captures / "bad.tagid.h5")))

    results = run_local(tasks(), a_job(), 1)
    while next(results) is None:
        pass
    assert os.environ["OMP_NUM_THREADS"] == "1"
    assert len(taken) <= 4
    results.close()
