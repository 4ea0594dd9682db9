"""Attacks with recordings, logs and positions as other people have them.

The files of the field lie in `shared/field` next to the checkout; where they are absent, an attack says so.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tagid.radar.framing import Framing, frame
from tagid.radar.messages import MessageType, encode
from tests.attacks import Outcome, attack

SHARED = Path(os.environ.get("TAGID_SHARED", Path(__file__).resolve().parents[2].parent / "shared"))
FIELD = SHARED / "field"
ABSENT = Outcome("the files of the field are absent", True)


def tagid(*words: str | Path) -> tuple[int, str, dict[str, Any]]:
    """Exit code, all messages in one text, and the JSON document of a command."""
    ran = subprocess.run(
        [sys.executable, "-P", "-m", "tagid", *map(str, words), "--output", "json"],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    try:
        document = json.loads(ran.stdout)
    except ValueError:
        document = {}
    return ran.returncode, " ".join((ran.stdout + ran.stderr).split()), document


def scans_of(folder: Path, file: Path) -> np.ndarray | None:
    """The samples that `tagid import` gets from a file; None where it fails."""
    out = folder / f"{file.name}.npz"
    code, _, _ = tagid("export", file, "--out", out, "--force")
    if code != 0:
        return None
    with np.load(out) as arrays:
        return np.array(arrays["samples"])


def alike(folder: Path, reference: Path, variants: Mapping[str, Path]) -> Outcome:
    """How many variants give the samples of the reference."""
    expected = scans_of(folder, reference)
    assert expected is not None
    wrong = []
    for name, path in variants.items():
        samples = scans_of(folder, path)
        if samples is None or not np.array_equal(samples, expected):
            wrong.append(name)
    figure = f"{len(variants) - len(wrong)} of {len(variants)} forms read"
    return Outcome(figure + (f"; not {', '.join(wrong)}" if wrong else ""), not wrong)


@attack(
    "field 1",
    "Recordings with a whole confirm, frames, prefixes or other messages around the scans",
    before="0 of 12 forms read",
    test="tests/unit/test_storage_recordings.py::test_messages_are_read_whatever_lies_between_them",
)
def wrapped_recordings(folder: Path) -> Outcome:
    """The reference recording in twelve forms."""
    if not FIELD.is_dir():
        return ABSENT
    data = (FIELD / "p440_reference.out").read_bytes()
    parts = [data[at : at + 1452] for at in range(32, len(data), 1452)]
    confirm = encode(MessageType.GET_CONFIG_CONFIRM, 9)[:4] + data[:32] + bytes(8)
    other = encode(MessageType.CONTROL_CONFIRM, 2)
    noise = np.random.default_rng(1)
    forms = {
        "usb": b"".join(frame(part, Framing.USB) for part in [confirm, *parts]),
        "uart": b"".join(frame(part, Framing.UART) for part in [confirm, *parts]),
        "no configuration": b"".join(parts),
        "lengths": b"".join(len(part).to_bytes(4, "little") + part for part in [confirm, *parts]),
        "packets": b"".join(noise.bytes(58) + part for part in [confirm, *parts]),
        "lines": confirm + b"\n" + b"\n".join(b"12:00:00.123 " + part for part in parts),
        "others": other + confirm + other.join(parts) + other,
        "lists": confirm + encode(MessageType.DETECTION_LIST_INFO, 3).join(parts),
        "filtered": confirm + b"".join(part + part[:38] + b"\4" + part[39:] for part in parts),
        "far": noise.bytes(300_000) + confirm + b"".join(parts),
        "end": confirm + b"".join(parts) + noise.bytes(700),
    }
    variants = {"confirm": FIELD / "p440_confirm_header.out"}
    for name, content in forms.items():
        variants[name] = folder / f"{name.replace(' ', '-')}.bin"
        variants[name].write_bytes(content)
    return alike(folder, FIELD / "p440_reference.out", variants)


@attack(
    "field 4",
    "Logs that passed through another program",
    before="0 of 11 forms read",
    test="tests/unit/test_storage_mrm_ret.py::test_a_log_that_another_program_saved_again",
)
def resaved_logs(folder: Path) -> Outcome:
    """The reference log as spreadsheets, data-frame libraries, locales and clients save it."""
    if not FIELD.is_dir():
        return ABSENT
    text = (FIELD / "log_reference.csv").read_text()
    rows = [line.split(", ") for line in text.splitlines()]
    scans = [row for row in rows if row[1] == "MrmFullScanInfo" and row[0] != "Timestamp"]
    width = max(map(len, rows))
    floats = [[row[0], row[1], *(f"{int(cell)}.0" for cell in row[2:])] for row in scans]
    forms = {
        "tabs": "\n".join("\t".join(row) for row in rows).encode(),
        "quotes": "\n".join(",".join(f'"{cell}"' for cell in row) for row in rows).encode(),
        "UTF-16": text.encode("utf-16"),
        "frame": "\n".join(f"{at}," + ",".join(row + [""] * (width - len(row)))
                           for at, row in enumerate(floats)).encode(),
        "dates": "\n".join(";".join(["26.11.2026 22:13:20,123", *row[1:]]) for row in scans).encode(),
        "wrapped": "\n".join(",\n".join(",".join(row[at : at + 64]) for at in range(0, len(row), 64))
                             for row in scans).encode(),
        "scientific": "\n".join(",".join([*row[:16], *(f"{int(cell):.5E}" for cell in row[16:])])
                                for row in scans).encode(),
    }  # fmt: skip
    names = {
        "no spaces": "log_without_spaces.csv",
        "semicolons": "log_semicolons.csv",
        "ticks": "log_ticks.csv",
    }
    variants = {name: FIELD / file for name, file in names.items()}
    variants["structs"] = FIELD / "scn_struct.mat"
    for name, content in forms.items():
        variants[name] = folder / f"{name}.csv"
        variants[name].write_bytes(content)
    return alike(folder, FIELD / "log_reference.csv", variants)


@attack(
    "field 5",
    "Other containers are named, with a way on",
    before="0 of 5",
    test="tests/unit/test_storage_foreign.py::test_other_containers_are_named_with_a_way_on",
)
def containers(folder: Path) -> Outcome:
    """A workbook, a pickle, JSON, a numpy array and a database."""
    contents = {
        "pickle": b"\x80\x04\x95" + bytes(40),
        "JSON": b'{"samples": [[1, 2], [3, 4]]}',
        "numpy array": b"\x93NUMPY\1\0" + bytes(120),
        "SQLite": b"SQLite format 3\0" + bytes(200),
    }
    files = {}
    for name, content in contents.items():
        files[name] = folder / name.replace(" ", "-")
        files[name].write_bytes(content)
    if FIELD.is_dir():
        files["workbook"] = FIELD / "log_excel.xlsx"
    good = 0
    for name, path in files.items():
        _, said, _ = tagid("import", path, "--out", folder / "x.tagid.h5", "--force")
        good += name in said and "numpy.savez(" in said
    return Outcome(f"{good} of {len(files)} named with a way on", good == len(files))


EVERY = ("import", "show", "identify", "reconstruct", "report")


def answers(folder: Path, file: Path, *motion: str) -> dict[str, str]:
    """What each command says of a file."""
    said = {}
    for command in EVERY:
        out = folder / f"{file.stem}-{command}"
        options: tuple[str | Path, ...] = {
            "import": ("--out", f"{out}.tagid.h5", "--force"),
            "show": ("--png", f"{out}.png"),
            "identify": motion,
            "reconstruct": ("--method", "bp", *motion),
            "report": ("--out", out, *motion),
        }[command]
        said[command] = tagid(command, file, *options)[1]
    return said


def all_say(folder: Path, expected: Mapping[str, tuple[str, ...]]) -> Outcome:
    """How many answers contain the words that are expected for their file."""
    total = good = 0
    silent = []
    for name, words in expected.items():
        for command, said in answers(folder, FIELD / f"{name}.npz").items():
            total += 1
            fine = all(word in said for word in words) and "larger reflector" not in said
            good += fine
            silent += [] if fine else [f"{command} {name}"]
    figure = f"{good} of {total} answers name the cause" + (f"; not {', '.join(silent)}" if silent else "")
    return Outcome(figure, good == total)


@attack(
    "field 9",
    "Positions in millimetres or with gaps, times in milliseconds",
    before="0 of 15 answers name the cause",
    test="tests/unit/test_intake.py::test_positions_in_other_units_name_the_unit",
)
def units_and_gaps(folder: Path) -> Outcome:
    """The three files, each with five commands."""
    if not FIELD.is_dir():
        return ABSENT
    return all_say(
        folder,
        {
            "path_in_mm": ("millimetres", "by 1000"),
            "path_with_gaps": ("3 of 60 views", "20 to 22", "interpolate"),
            "turn_time_in_ms": ("milliseconds", "by 1000"),
        },
    )


@attack(
    "field 13",
    "Sign of phase and baseband: every command says what reconstruct says",
    before="2 of 10 answers name the cause",
    test="tests/unit/test_intake.py::test_every_command_says_what_is_wrong_with_the_samples",
)
def sign_and_baseband(folder: Path) -> Outcome:
    """The two files, each with five commands."""
    if not FIELD.is_dir():
        return ABSENT
    return all_say(
        folder,
        {"turn_conjugate": ("complex conjugate",), "turn_baseband": ("ultiply the samples",)},
    )
