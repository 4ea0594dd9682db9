"""What a first-time user does and mistakes: each answer names the cause and what works.

The commands run in this process, which costs a tenth of a process each.
"""

from __future__ import annotations

import io
import re
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from command_server import Ran

from tagid.cli.app import app
from tagid.cli.frame import serve
from tagid.enrolling.registry import Registry
from tagid.errors import DeviceError
from tagid.motion.discovery import MotionDevice
from tagid.storage.importers import read_any

POINTS = ("--point", "0.1,0", "--point", "-0.05,0.03", "--point", "0.02,-0.09")


@pytest.fixture
def here(tmp_path: Path, home: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ran]:
    for name, value in home.items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)

    def run(*words: object, **environment: str) -> Ran:
        out, err = io.StringIO(), io.StringIO()
        with monkeypatch.context() as patched, redirect_stdout(out), redirect_stderr(err):
            for name, value in environment.items():
                patched.setenv(name, value)
            patched.setattr(sys, "argv", ["tagid", *map(str, words)])
            code = serve(app)
        return Ran(code, out.getvalue(), err.getvalue())

    return run


def test_a_set_that_cannot_be_enrolled_comes_with_options_that_work(here, tmp_path: Path) -> None:
    words = ("layouts", "design", "--object", "container", "--reflectors", 2, "--spacing", 0.08)
    words += ("--count", 5, "--output", "json")
    five = here(*words, "--out", "five.toml").json["data"]
    assert not five["can_be_enrolled"] and here("layouts", "import", "five.toml").code == 1
    options = re.findall(r"--\w+ \d+(?:\.\d+)?", five["advice"])
    assert len(options) == 2
    for number, option in enumerate(options):
        data = str(tmp_path / f"data{number}")
        out = f"{number}.toml"
        again = here(*words, *option.split(), "--out", out, TAGID_DATA=data).json["data"]
        assert again["can_be_enrolled"] and here("layouts", "import", out, TAGID_DATA=data).code == 0
        # Sets that differ bear other names, so one can be imported beside the other.
        names = {layout["name"] for layout in again["layouts"]}
        assert not names & {layout["name"] for layout in five["layouts"]}


def test_undo_says_what_it_undid_and_redo_takes_it_back(here, tmp_path: Path) -> None:
    assert here("enroll", "mine", *POINTS).code == 0
    undone = here("layouts", "undo")
    assert "undone: " in undone.out and "removed mine" in undone.out
    redone = here("layouts", "redo")
    assert "redone: tagid enroll" in redone.out and "added mine" in redone.out
    history = here("layouts", "--history", COLUMNS="80").out
    assert len(re.findall(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ", history)) >= 6 and "…" not in history
    nothing = here("layouts", "redo")
    assert nothing.code == 1 and "nothing to redo" in nothing.err
    assert here("layouts", "export", "all.toml").code == 0
    before = (tmp_path / "all.toml").read_bytes()
    refused = here("layouts", "export", "all.toml", "mine")
    assert refused.code == 1 and "--force" in refused.err and (tmp_path / "all.toml").read_bytes() == before
    assert here("layouts", "export", "all.toml", "mine", "--force").code == 0


@pytest.mark.parametrize(
    ("option", "value", "remedy"),
    [
        ("--snr", "1e9", "-100 to 300 dB"),
        ("--snr", "nan", "-100 to 300 dB"),
        ("--noise", "nan", "0 to 1e+06"),
        ("--unlike", "nan", "0 to 20 dB"),
        ("--axis-distance", "nan", "Give metres"),
        ("--axis-error", "-1", "Give metres"),
        ("--antenna-height", "inf", "Give metres"),
        ("--wobble", "nan", "0.01 for 1 %"),
        ("--wobble", "-0.1", "0.01 for 1 %"),
        ("--centre", "4,-2", "4 m? Give metres"),
        ("--centre", "-0.2,0.2", "at most 0.25 m"),
        ("--seed", "-1", "--seed"),
    ],
)
def test_numbers_that_cannot_be_simulated_are_refused_with_their_range(
    here, tmp_path: Path, option: str, value: str, remedy: str
) -> None:
    done = here("simulate", "helmet-120", "--views", 12, option, value, "--out", "x.tagid.h5")
    assert done.code == 2 and remedy in " ".join(done.err.split()), done.err
    assert not list(tmp_path.glob("x*"))


@pytest.mark.parametrize(
    "words",
    [
        ("p440", "--snr", "nan"),
        ("p440", "--centre", "0.3,0"),
        ("p440", "--axis-distance", "inf"),
        ("p440", "--wobble", "nan"),
        ("p440", "--delay-ms", "inf"),
        ("p440", "--seed", "-1"),
        ("roomba", "--slip-noise", "nan"),
        ("roomba", "--encoder-noise", "inf"),
        ("roomba", "--truth", "70000"),
        ("comxim", "--rate-error", "inf"),
    ],
)
def test_numbers_that_cannot_be_emulated_are_refused(
    here, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    def listening(*_: object) -> None:
        raise AssertionError("the emulator started")

    monkeypatch.setattr("tagid.cli.emulate.announce", listening)
    done = here("emulate", *words)
    assert done.code == 2 and any(word in done.err for word in ("Give", "range", "should be")), done.err


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        ("helmet-120", r"SNR 13\.\d dB; .* 15\.0 dB per reflector, 1[89]\.\d dB summed at integration .*"),
        ("empty", r"nothing changes; peak over noise 15\.0 dB, of a single reflector .*"),
    ],
)
def test_an_emulated_radar_says_the_snr_that_it_applies(
    here, monkeypatch: pytest.MonkeyPatch, scene: str, said: str
) -> None:
    def listens(_core: object, _options: object, _stop: object, ready: Callable[[str, int], None]) -> None:
        ready("127.0.0.1", 1)

    monkeypatch.setattr("tagid.radar.emulation.emulator.serve_udp", listens)
    done = here("emulate", "p440", "--scene", scene, "--snr", 15)
    assert done.code == 0 and re.search(rf"^{said}$", done.err, re.M), done.err
    assert "SNR" not in here("emulate", "p440", "--quiet").err


def test_an_own_layout_is_simulated_emulated_and_its_truth_kept(
    here, home: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert here("enroll", "mine", *POINTS).code == 0
    where = ("--rotation", 30, "--centre", "0.004,-0.002", "--wobble", 0.01)
    assert here("simulate", "mine", *where, "--views", 18, "--out", "mine.tagid.h5").code == 0
    design = ("layouts", "design", "--object", "helmet", "--count", 2, "--out", "two.toml")
    made = here(*design, "--output", "json")
    name = made.json["data"]["layouts"][1]["name"]
    assert here("simulate", name, "--file", "two.toml", "--views", 12, "--out", "two.tagid.h5").code == 0
    unnamed = here("simulate", "--file", "two.toml", "--out", "three.tagid.h5")
    assert unnamed.code == 2 and name in unnamed.err
    truth = ("--truth", "truth.json")
    process = subprocess.Popen(
        [sys.executable, "-m", "tagid", "emulate", "p440", "--bind", "127.0.0.1:0", "--scene", "mine",
         "--rpm", "45", "--rate", "0", *map(str, (*where, *truth))],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home, cwd=tmp_path,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        # The URL stands alone on its line, to be copied.
        url = process.stdout.readline().strip()
        assert re.fullmatch(r"udp://127\.0\.0\.1:\d+", url)
        # Fewer scans per turn are enough here.
        monkeypatch.setenv("TAGID_RADAR_INTEGRATION", "15")
        scan = ("scan", "--radar", url, "--axis-distance", 1, "--motion", "free?rpm=45", "--method", "bp")
        ran = here(*scan, *truth, "--note", "second", "--output", "json")
    finally:
        process.terminate()
        said = process.communicate(timeout=10)[1]
    assert f"tagid scan --radar {url}" in said
    (item,) = ran.json["data"]["items"]
    assert (item["status"], item["layout"]) == ("identified", "mine")
    about = read_any(tmp_path / ran.json["data"]["files"]["capture"]).object
    assert about.note == "second" and about.layout == "mine" and about.truth is not None
    assert about.truth.rotation_deg == pytest.approx(30) and about.truth.wobble_speed == 0.01
    assert about.truth.centre_m == (0.004, -0.002)
    simulated = read_any(tmp_path / "mine.tagid.h5").object.truth
    assert simulated is not None and simulated.centre_m == about.truth.centre_m


def test_an_unknown_answer_names_the_nearest_layout_and_the_axis_distance_that_is_meant(here) -> None:
    # Most tags are read with such an error all the same.
    words = ("--body", "can:28mm", "--views", 24, "--snr", 10, "--axis-error", 0.15, "--seed", 4)
    assert here("simulate", "container-90", *words, "--out", "far.tagid.h5").code == 0
    ran = here("identify", "far.tagid.h5")
    assert ran.code == 3 and ran.out.startswith("UNKNOWN TAG   far.tagid.h5\n  likely cause: ")
    assert "with an axis distance of 1.00 m instead of 1.15 m" in ran.out and "why:" not in ran.out
    assert "nearest layout: container-90" in here("identify", "-v", "far.tagid.h5").out
    # What is advised works.
    ready = re.search(r"`tagid (identify .*)`", ran.out)
    assert ready is not None
    again = here(*ready[1].split(), "--output", "json")
    (item,) = again.json["data"]["items"]
    assert item["layout"] == item["nearest"]["layout"] == "container-90" and item["causes"] == []


def test_options_offered_where_nothing_fits_work(here) -> None:
    given = ("layouts", "design", "--output", "json", "--radius", 0.025, "--count", 2)
    refused = here(*given)
    assert refused.code == 2
    remedy = refused.json["errors"][0]["remedy"]
    advice = remedy.removeprefix("These work: ").removesuffix(".").split(", or ")
    assert remedy.startswith("These work: ") and all(advice)
    for options in advice:
        # An option given twice counts as given last.
        again = here(*given, *options.split())
        assert again.code == 0 and again.json["data"]["can_be_enrolled"], options
    none = here("layouts", "design", "--radius", 0.012, "--count", 2)
    assert none.code == 2 and "larger object" in none.err and "--" not in none.err.split("what to do")[1]


def test_devices_found_without_bluetooth_are_a_success_with_a_note(
    here, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_bluetooth(*_: object) -> list[MotionDevice]:
        raise DeviceError("there is no Bluetooth controller", "Plug one in.")

    port = MotionDevice(url="roomba+serial:///dev/ttyUSB9", what="USB serial", where="/dev/ttyUSB9")
    monkeypatch.setattr("tagid.motion.discovery.bluetooth_devices", no_bluetooth)
    monkeypatch.setattr("tagid.motion.discovery.serial_devices", lambda: [port])
    result = here("motion", "find")
    assert result.code == 0 and "error:" not in result.err and "no Bluetooth controller" in result.err
    document = here("motion", "find", "--output", "json").json
    assert document["status"] == "success" and not document["errors"] and document["messages"]
    monkeypatch.setattr("tagid.motion.discovery.serial_devices", lambda: [])
    nothing = here("motion", "find")
    assert nothing.code == 4 and "error: there is no Bluetooth controller" in nothing.err


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("radar.url", "http://x", "udp://HOST"),
        ("radar.url", "192.168.1.100", "udp://HOST"),
        ("motion.url", "turntable", "free?rpm=2"),
        ("motion.url", "free?rpm=fast", "number"),
    ],
)
def test_a_url_that_no_command_could_open_is_not_stored(
    here, tmp_path: Path, name: str, value: str, remedy: str
) -> None:
    refused = here("config", "set", name, value)
    assert refused.code == 2 and remedy in " ".join(refused.err.split()), refused.err
    assert here("config", "--output", "json").json["data"]["settings"][name]["source"] == "default"
    for url in ("udp://192.168.1.100", "emulator://helmet-120?seed=1"):
        assert here("config", "set", "radar.url", url).code == 0
    assert here("config", "set", "motion.url", "free?rpm=2").code == 0


def test_a_kind_is_checked_before_the_captures_are_read(here) -> None:
    refused = here("enroll", "mine", "--kind", "foo", "--capture", "none.tagid.h5")
    assert (
        refused.code == 2 and "--kind is 'foo'" in refused.err and "helmet, container, other" in refused.err
    )


def test_a_capture_is_not_joined_with_itself(here, tmp_path: Path) -> None:
    assert here("simulate", "helmet-120", "--views", 24, "--out", "a.tagid.h5").code == 0
    other = ("--antenna-height", 0.2, "--seed", 1, "--out", "b.tagid.h5")
    assert here("simulate", "helmet-120", "--views", 24, *other).code == 0
    refused = here("join", "b.tagid.h5", "a.tagid.h5", "a.tagid.h5", "--out", "c.tagid.h5")
    assert refused.code == 2 and "captures 2 and 3 are the same recording" in refused.err
    assert not (tmp_path / "c.tagid.h5").exists()
    assert here("join", "b.tagid.h5", "a.tagid.h5", "--out", "c.tagid.h5").code == 0


def test_a_plan_does_not_promise_a_rate_that_the_table_does_not(here) -> None:
    words = ("plan", "--reflector", "octahedron:40mm")
    reported = here(*words, "--want", 0.99)
    text = " ".join(reported.out.split())
    data = here(*words, "--want", 0.99, "--output", "json").json["data"]
    named, scenes = data["wanted"]["reflector"]["rates"]["named"], data["wanted"]["reflector"]["rates_scenes"]
    assert named[0] >= 0.99 > named[1] and scenes == data["rates_scenes"] < 381
    assert f"named 100 % ({100 * named[1]:.0f} to 100), {scenes} scenes" in text
    assert f"the table cannot promise 99 %: with {scenes} scenes" in text and "381 scenes" in text
    assert "in 99.5 % of readings" in " ".join(here(*words, "--want", 0.995).out.split())
    modest = here(*words, "--want", 0.5, "--output", "json").json["data"]
    assert modest["wanted"]["reflector"]["rates"]["named"][1] >= 0.5
    assert modest["wanted_remark"] == "" and "cannot promise" in data["wanted_remark"]


def test_watch_makes_its_folder(here, tmp_path: Path) -> None:
    assert here("report", "--watch", "in/box", "--idle-stop", 0.2, "--out", "r", "--jobs", 1).code == 0
    assert (tmp_path / "in" / "box").is_dir()
    (tmp_path / "file").write_text("")
    taken = here("report", "--watch", "file", "--idle-stop", 0.2, "--out", "r2")
    assert taken.code == 2 and "is not a folder" in taken.err


def test_layouts_are_listed_as_the_registry_holds_them(here, tmp_path: Path) -> None:
    assert here("enroll", "mine", *POINTS).code == 0
    listed = here("layouts", "--output", "json").json["data"]
    kept = Registry(tmp_path / "home" / "registry.sqlite")
    assert listed["layouts"] == [layout.to_dict() for layout in kept.layouts()]
    assert listed["registry_version"] == kept.version
    with sqlite3.connect(kept.path) as connection:
        connection.execute(
            "UPDATE layout SET definition = replace(definition, '0.09', '9') WHERE name = 'mine'"
        )
    connection.close()
    damaged = here("layouts")
    assert damaged.code == 1 and "damaged definition of 'mine'" in damaged.err


def test_a_terminal_without_umlauts_costs_no_answer(here, home: dict[str, str], tmp_path: Path) -> None:
    here("simulate", "helmet-120", "--views", 12, "--out", "gr\u00fcn.tagid.h5")
    command = [sys.executable, "-m", "tagid", "show", "gr\u00fcn.tagid.h5"]
    done = subprocess.run(
        command, cwd=tmp_path, env={**home, "PYTHONIOENCODING": "ascii"}, capture_output=True, text=True
    )
    assert done.returncode == 0 and "gr\\xfcn" in done.stdout, done.stderr


def test_lengths_take_a_unit_and_negative_values_are_values(here, tmp_path: Path) -> None:
    for words in ("config set motion.axis_distance_m 100", "identify x --axis-distance 100"):
        metres = here(*words.split())
        assert metres.code == 2 and "100 m? Give metres" in metres.err
    assert not (tmp_path / "home" / "config.toml").exists()
    assert here("config", "set", "motion.axis_distance_m", "100cm").code == 0
    shown = here("config", "show", "motion.axis_distance_m", "--output", "json").json["data"]
    assert shown["settings"]["motion.axis_distance_m"]["value"] == 1.0
    refused = here("config", "set", "motion.axis_distance_m", "-1")
    assert refused.code == 2 and "expected 0.001 to 20" in refused.err
    assert here("config", "set", "motion.antenna_height_m", "-5cm").code == 0
    unknown = here("config", "set", "motion.axis_distance_m", "-x")
    assert unknown.code == 2 and "No such option: -x" in unknown.err
    words = ("simulate", "--scene", "helmet-120", "--views", 12, "--out")
    assert here(*words, "a.npz", "--axis-distance", "100cm").code == 0
    wrong = here(*words, "b.npz", "--axis-distance", "1yd")
    assert wrong.code == 2 and "m, cm, mm" in wrong.err
    outside = here("radar", "config", "--start", "100000m", "--radar", "udp://127.0.0.1:9")
    assert outside.code == 2 and "-10000 to 10000" in outside.err


def test_old_and_new_forms_do_the_same(here, tmp_path: Path) -> None:
    for words in (("layouts", "remove", "helmet-120"), ("layouts", "--remove", "helmet-120")):
        assert here(*words).code == 0
        assert "added helmet-120" in here("layouts", "undo", "-y").out
    for words in (("--scene", "can"), ("can",)):
        assert here("simulate", *words, "--views", 12, "--out", "c.npz", "--force").code == 0
    both = here("simulate", "can", "--scene", "can", "--views", 12, "--out", "d.npz")
    assert both.code == 2 and "twice" in both.err
    for words in (("--motion", "free?rpm=2"), ("free?rpm=2",)):
        assert "not a commanded device" in here("motion", "info", *words).err
    for option in ("--integration", "--pii"):
        assert here("plan", option, 99).code == 2
    near = here("layouts", "show", "helmet120")
    assert near.code == 1 and "Did you mean helmet-120?" in near.err
    np.savez(tmp_path / "scan-1.image.npz", image=np.zeros((2, 2)))
    image = here("identify", "scan-1.image.npz")
    assert image.code == 1 and "an image" in image.err and "scan-1.tagid.h5" in image.err


def test_no_name_url_or_command_is_cut(here) -> None:
    assert "<bool>" not in here("scan", "--help").out
    url = "udp://radar-in-the-long-hall.example.org:21210"
    assert here("config", "set", "radar.url", url).code == 0
    for columns in ("40", "80", "160"):
        listed = here("config", COLUMNS=columns).out
        assert any(url in line.split() for line in listed.splitlines()), columns
        if columns == "80":
            assert "motion.antenna_height_m" in listed and "radar.cable_delay_sigma_ps" in listed
            assert "…" not in listed
    assert here("config", "unset", "radar.url").code == 0
    name = "scan-of-the-second-object-on-the-third-shelf-20261126-161012.tagid.h5"
    assert here("simulate", "--scene", "container-90", "--views", 18, "--out", name).code == 0
    assert here("identify", name, COLUMNS="60").code == 0
    assert name in here("history", COLUMNS="60").out
    settings = here("config", COLUMNS="60").out
    assert (
        "heights of the antenna at which every object is scanned, m, comma-separated; empty: one" in settings
    )
    doctor = here("doctor", COLUMNS="60")
    assert doctor.code == 0 and "tagid config set radar.url udp://192.168.1.100" in doctor.out
    assert here("doctor", "--radar", "").code == 1, "a radar was asked for"


def test_a_wrong_port_is_named(here) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        port = silent.getsockname()[1]
        done = here("radar", "info", "--radar", f"udp://127.0.0.1:{port}")
    assert done.code == 4 and f"the port of the URL ({port}; a P440 listens on 21210)" in done.err
    assert "tagid doctor" not in done.err
