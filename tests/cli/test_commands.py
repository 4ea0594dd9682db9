"""The commands as their users meet them: answers, envelope, exit codes, files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer.main
from typer.testing import CliRunner

from tagid.cli.app import COMMANDS, app
from tagid.storage.journal import JournalWriter

ENVELOPE = {"tagid_result_version", "command", "status", "exit_code", "data", "messages", "errors"}
IDENTIFICATION = {
    "status", "layout", "label", "score", "margin", "rotation_deg", "centre_m", "reflectors", "missing",
    "extra", "capture_uuid", "tool_version", "registry_version", "seconds",
}  # fmt: skip


def test_every_command_has_help_with_an_example_and_is_listed_with_its_first_sentence() -> None:
    """Commands are imported when called: their first sentences are kept apart so that help need not."""
    root = typer.main.get_group(app)
    assert root.list_commands(None) == list(COMMANDS)
    for name, entry in COMMANDS.items():
        command = root.get_command(None, name)
        text = (command.short_help or command.help or "").split("\n\n")[0].replace("\n", " ")
        assert entry.help == text, name
        inner = command.list_commands(None) if hasattr(command, "list_commands") else []
        for words in [f"{name} {item}" for item in inner] or [name]:
            done = CliRunner().invoke(app, [*words.split(), "--help"])
            assert done.exit_code == 0, words
            assert f"Example: tagid {words}" in " ".join(done.output.split())


def test_simulate_identify_and_reconstruct(tagid, tmp_path: Path) -> None:
    made = tagid(
        "simulate", "helmet-120", "--views", 18, "--snr", 15, "--out", "h.tagid.h5", "--rotation", 40
    )
    assert made.code == 0, made.err
    done = tagid("identify", "h.tagid.h5", "--output", "json")
    document = done.json
    assert set(document) == ENVELOPE
    assert (done.code, document["exit_code"], document["status"]) == (0, 0, "success")
    (item,) = document["data"]["items"]
    assert set(item) >= IDENTIFICATION
    assert (item["status"], item["layout"]) == ("identified", "helmet-120")
    assert item["rotation_deg"] % 120 == pytest.approx(40, abs=2)
    assert [reflector["matched"] for reflector in item["reflectors"]] == [True] * 3
    image = tagid(
        "reconstruct", "h.tagid.h5", "--method", "bp", "--out", "i.npz", "--png", "i.png", "--pixels", 64
    )
    assert image.code == 0, image.err
    with np.load(tmp_path / "i.npz", allow_pickle=False) as file:
        assert (file["image"].shape, file["image"].dtype) == ((64, 64), np.complex64)
        y, x = np.unravel_index(np.abs(file["image"]).argmax(), (64, 64))
        radius = np.hypot(file["x_m"][x], file["y_m"][y])
    assert radius == pytest.approx(0.11, abs=0.01)
    assert (tmp_path / "i.png").read_bytes().startswith(b"\x89PNG")


def test_a_command_has_one_thread_of_linear_algebra_unless_told_otherwise() -> None:
    """On a busy computer, BLAS threads that wait for each other take all of its time."""
    code = (
        "import sys, tagid.cli.app\n"
        "sys.argv = ['tagid', '--version']\n"
        "try: tagid.cli.app.main()\n"
        "except SystemExit: pass\n"
        "import numpy\n"
        "a = numpy.ones((600, 600), numpy.float32) @ numpy.ones((600, 600), numpy.float32)\n"
        "print([line.split()[1] for line in open('/proc/self/status') if line.startswith('Threads')][0])\n"
    )
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}

    def threads(**more: str) -> int:
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment | more, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return int(done.stdout.split()[-1])

    assert threads() == 1
    if (os.cpu_count() or 1) > 1:
        assert threads(OPENBLAS_NUM_THREADS="2") == 2


def test_uncertain_answers_and_failed_items_have_their_exit_codes(tagid, tmp_path: Path) -> None:
    tagid("simulate", "empty", "--views", 12, "--out", "empty.tagid.h5")
    tagid("simulate", "container-90", "--views", 18, "--out", "tag.tagid.h5")
    empty = tagid("identify", "empty.tagid.h5", "--output", "json")
    (item,) = empty.json["data"]["items"]
    assert (empty.code, item["status"], item["layout"]) == (3, "no_tag", None)
    (tmp_path / "bad.tagid.h5").write_bytes(b"not a capture")
    batch = tagid("identify", "tag.tagid.h5", "bad.tagid.h5", "--output", "json")
    assert (batch.code, batch.json["status"]) == (5, "partial")
    assert [item["status"] for item in batch.json["data"]["items"]] == ["identified", "failed"]
    alone = tagid("identify", "bad.tagid.h5", "--output", "json")
    assert (alone.code, alone.json["status"]) == (1, "error")
    assert alone.json["errors"][0]["code"] == "bad_file"


def test_wrong_command_lines_end_with_2_in_the_wanted_format(tagid) -> None:
    near = tagid("reconstuct")
    assert near.code == 2 and "Did you mean 'reconstruct'?" in near.err
    setting = tagid("config", "set", "moton.url", "free?rpm=2")
    assert setting.code == 2 and "Did you mean motion.url?" in setting.err
    done = tagid("identify", "--no-such-option", "--output", "json")
    assert (done.code, done.json["exit_code"]) == (2, 2)
    assert set(done.json) == ENVELOPE
    assert tagid("scan", "--radar", "ftp://x", "--axis-distance", 1).code == 2
    assert tagid("scan", "--radar", "udp://127.0.0.1", "--axis-distance", -1).code == 2
    assert tagid("reconstruct", "x.npz", "--method", "magic").code == 2
    assert tagid("config", "set", "radar.gain", "100").code == 2
    bare = tagid("scan")
    assert bare.code == 2 and "radar.url" in bare.err and "--demo" in bare.err


def test_enroll_prints_distances_and_refuses_what_could_be_confused(tagid, tmp_path: Path) -> None:
    points = ("--point", "0.1,0", "--point", "-0.05,0.03", "--point", "0.02,-0.09")
    done = tagid("enroll", "mine", *points, "--kind", "helmet", "--output", "json")
    assert done.code == 0, done.err
    assert set(done.json["data"]["distances"]) == {
        "container-90", "container-180", "helmet-120", "helmet-linear"
    }  # fmt: skip
    near = ("--point", "0.1,0.001", "--point", "-0.05,0.031", "--point", "0.02,-0.09")
    refused = tagid("enroll", "near", *near, "--output", "json")
    assert (refused.code, refused.json["errors"][0]["code"]) == (1, "layout_conflict")
    assert tagid("enroll", "near", *near, "--force").code == 0
    (tmp_path / "l.toml").write_text('name = "filed"\npositions_m = [[0.05, 0], [-0.08, 0.03]]\n')
    assert tagid("enroll", "--file", "l.toml").code == 0
    names = [layout["name"] for layout in tagid("layouts", "--output", "json").json["data"]["layouts"]]
    assert {"mine", "near", "filed"} <= set(names)
    assert tagid("layouts", "--remove", "mine").code == 0
    history = tagid("layouts", "--history", "--output", "json").json["data"]["history"]
    assert [c["action"] for c in history if c["name"] == "mine"] == ["add", "remove"]
    assert tagid("enroll", "x", "--point", "1;2").code == 2
    assert tagid("enroll", "x").code == 2


def test_no_color_and_quiet(tagid) -> None:
    tagid("simulate", "container-90", "--views", 18, "--out", "c.tagid.h5")
    done = tagid("identify", "c.tagid.h5", "--preview", "-q", NO_COLOR="1", FORCE_COLOR="1")
    assert (done.code, done.err) == (0, "")
    assert "\x1b[3" not in done.out and "\x1b[4" not in done.out


def test_recover_turns_a_journal_into_a_capture(tagid, tmp_path: Path) -> None:
    header = {"range_start_m": 0.5, "range_step_m": 0.009, "radar": {"config": {}}}
    with JournalWriter(tmp_path / "s.tagid.journal", header) as journal:
        for number in range(5):
            journal.append(number, number, float(number), np.arange(96, dtype=np.int32))
    with (tmp_path / "s.tagid.journal").open("ab") as file:
        file.write(b"half a record")
    done = tagid("recover", "s.tagid.journal", "--output", "json")
    assert done.code == 0
    assert done.json["data"] == {
        "path": "s.tagid.h5", "paths": ["s.tagid.h5"], "views": 5, "complete": False, "bytes_dropped": 13
    }  # fmt: skip
    again = tagid("recover", "s.tagid.journal")
    assert again.code == 1 and "exists already" in again.err


def test_doctor_finds_a_radar_that_does_not_answer(tagid) -> None:
    well = tagid("doctor", "--output", "json")
    assert well.code == 0
    topics = {finding["topic"] for finding in well.json["data"]["findings"]}
    assert {"disk", "layouts", "radar", "packages", "serial ports"} <= topics
    ill = tagid("doctor", "--radar", "udp://127.0.0.1:9", "--output", "json", TAGID_RADAR_TIMEOUT_S="0.1")
    assert (ill.code, ill.json["data"]["problems"]) == (1, 1)


def test_show_leaves_the_image_of_a_scan_alone(tagid, tmp_path: Path) -> None:
    tagid("simulate", "container-90", "--views", 8, "--out", "c.tagid.h5")
    (tmp_path / "c.png").write_bytes(b"the image of the scan")
    shown = tagid("show", "c.tagid.h5", "--output", "json")
    assert shown.json["data"]["png"] == "c.show.png" and (tmp_path / "c.show.png").stat().st_size > 1000
    assert (tmp_path / "c.png").read_bytes() == b"the image of the scan"


@pytest.mark.parametrize(
    ("words", "streams", "code"),
    [
        ("config --output json", ">&- 2>&- <&-", 0),
        ("config", "| sleep 0", 0),
        ("no-command", "2>&1 | sleep 0", 2),
        ("--help", ">/dev/full", 1),
        ("layouts --output json", ">/dev/full", 1),
    ],
)
def test_the_exit_code_is_that_of_the_answer_whatever_the_streams(
    tmp_path: Path, words: str, streams: str, code: int
) -> None:
    """Streams that are closed when the process starts, that end meanwhile, or that take nothing."""
    line = f"({sys.executable} -m tagid {words}; echo $? > code) {streams}"
    if "|" not in streams:
        line = f"{sys.executable} -m tagid {words} {streams}; echo $? > code"
    environment = {**os.environ, "TAGID_CONFIG": "c.toml", "TAGID_DATA": "data"}
    done = subprocess.run(line, shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (tmp_path / "code").read_text() == f"{code}\n"
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr
    assert code != 1 or done.stderr.count("error:") == 1


def test_no_file_gets_the_number_of_a_closed_stream(tmp_path: Path) -> None:
    """What is printed would go into it."""
    code = (
        "import os, sys\n"
        "from tagid.cli import frame\n"
        "frame._secure_streams()\n"
        "file = os.open('data', os.O_WRONLY | os.O_CREAT)\n"
        "os.write(1, b'printed'); os.write(2, b'printed'); print('printed'); sys.stderr.write('printed')\n"
        "assert sys.stdin.read() == ''\n"
        "sys.exit(file <= 2)"
    )
    line = f'{sys.executable} -c "{code}" <&- >&- 2>&-'
    assert subprocess.run(line, shell=True, cwd=tmp_path).returncode == 0
    assert (tmp_path / "data").read_bytes() == b""


@pytest.mark.parametrize("words", [(), ("radar",)])
def test_a_program_or_group_alone_prints_its_help(tagid, words) -> None:
    done = tagid(*words)
    assert (done.code, done.err) == (0, "")
    assert done.out == tagid(*words, "--help").out
