"""How much of a turn `tagid scan --until-sure` needs, and how often it gives a false name.

Every turn becomes a line of a JSONL file, so a run can be stopped and continued, or done in pieces:

    python tests/benchmarks/until_sure.py null --purpose calibrate --count 2000
    python tests/benchmarks/until_sure.py write            # makes tagid/reading/ending.json
    python tests/benchmarks/until_sure.py null --purpose report --first 2000 --count 2000
    python tests/benchmarks/until_sure.py whole --purpose report --first 2000 --count 400
    python tests/benchmarks/until_sure.py tags --purpose report --count 40
    python tests/benchmarks/until_sure.py report           # writes docs/results/until-sure.md

`--purpose choose` is for choosing constants; nothing is chosen on the other two. Null turns of the report
below 2,000 were seen when the looks were changed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from until_sure_scenes import FIRST, STATEMENT, Turn, null_turn, tagged_body_turn, tagged_turn

from tagid.pipeline.identify import reader_settings
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings
from tagid.reading.ending import EndingCalibration
from tagid.reading.looks import LOOKS, SPENT, Look, largest, look, part_of_turn
from tagid.reading.reader import read
from tagid.reading.reading import Reading

ROOT = Path(__file__).resolve().parents[2]
CALIBRATION = ROOT / "tagid" / "reading" / "ending.json"
FALSE_ACCEPT = 1e-3
FEWEST_VIEWS = 32
"""Views per turn that a scan needs: those of the calibration, less the error of their angle."""
SNRS_DB = (20.0, 10.0, 5.0)
SETS = ("paper", "helmet-16")
SCALES = (0.95, 0.97, 1.03, 1.05)
BODIES = (("own", "none"), ("own", "can"), ("own", "cup"), ("own", "helmet"))
BODIES += (("full-wave", "none"), ("full-wave", "can"), ("full-wave", "helmet"))
Row = dict[str, Any]


def read_looks(turn: Turn, needed: Callable[[Look], bool]) -> list[Look]:
    """The looks at a turn; only the middle one where `needed` says that no other can matter."""
    middle = look(part_of_turn(turn.capture, LOOKS[1]), turn.layouts, LOOKS[1])
    if not needed(middle):
        return [middle]
    first, last = (look(part_of_turn(turn.capture, s), turn.layouts, s) for s in (LOOKS[0], LOOKS[2]))
    return [first, middle, last]


def as_row(one: Look) -> Row:
    """A look as JSON values."""
    score = one.score if math.isfinite(one.score) else None
    return {"share": one.share, "views": one.views, "layout": one.layout, "score": score}


def whole_turn(turn: Turn, spent: float) -> Reading:
    """What the reader says after the whole turn, where early looks have spent a share of the error."""
    settings = ImagingSettings(false_accept=FALSE_ACCEPT)
    scans = PreparedCapture(turn.capture, settings).scans(settings.preprocessing(False))
    return read(scans, turn.layouts, reader_settings(settings, spent))


def about(turn: Turn) -> Row:
    """A turn as JSON values."""
    return {
        "kind": turn.kind,
        "enrolled": turn.enrolled,
        "name": turn.name,
        "views": turn.views,
        "snr_db": turn.snr_db,
    }


def null_row(purpose: str, number: int) -> Row:
    """The looks at a null turn. Both pairs of looks contain the middle one, which often decides alone."""
    turn = null_turn(purpose, number)
    looks = read_looks(turn, lambda middle: middle.layout is not None)
    score = largest(looks) if len(looks) == len(LOOKS) else -math.inf
    return {**about(turn), "looks": [as_row(one) for one in looks], **_scored(score)}


def whole_row(purpose: str, number: int) -> Row:
    """The whole-turn answer of a null turn with the error that the early looks leave, and with all of it."""
    turn = null_turn(purpose, number)
    rest = whole_turn(turn, SPENT)
    every = rest if rest.status == "identified" else whole_turn(turn, 0.0)
    return {**about(turn), "rest": _answer(rest), "whole": _answer(every), "as": rest.kind.value}


def tag_row(turn: Turn) -> Row:
    """All looks at a turn with a tag, and the whole turn."""
    looks = read_looks(turn, lambda middle: True)
    every = whole_turn(turn, 0.0)
    rest = whole_turn(turn, SPENT) if every.status == "identified" else every
    rows = [as_row(one) for one in looks]
    return {**about(turn), "looks": rows, "rest": _answer(rest), "whole": _answer(every)}


def _answer(reading: Reading) -> Row:
    return {"status": reading.status, "layout": reading.layout, "kind": reading.kind.value}


def _scored(score: float) -> Row:
    return {"largest": score if math.isfinite(score) else None}


def tasks(arguments: argparse.Namespace) -> Iterator[tuple[str, Callable[[], Row]]]:
    """Key and work of every turn, in the order in which they are read."""
    purpose = arguments.purpose
    for number in range(arguments.first, arguments.first + arguments.count):
        if arguments.what == "null":
            yield f"{number}", lambda number=number: null_row(purpose, number)
        elif arguments.what == "whole":
            yield f"{number}", lambda number=number: whole_row(purpose, number)
        elif arguments.what == "tags":
            for enrolled in SETS:
                for snr in SNRS_DB:
                    yield (
                        f"{enrolled}/{snr:g}/{number}",
                        lambda e=enrolled, s=snr, n=number: tag_row(tagged_turn(purpose, n, e, s)),
                    )
        elif arguments.what == "speed":
            for scale in SCALES:
                yield (
                    f"{scale:g}/{number}",
                    lambda f=scale, n=number: {
                        "scale": f,
                        **tag_row(tagged_turn(purpose, n, "paper", 10.0, f)),
                    },
                )
        else:
            for world, body in BODIES:
                for snr in SNRS_DB[:2]:
                    yield (
                        f"{world}/{body}/{snr:g}/{number}",
                        lambda w=world, b=body, s=snr, n=number: tag_row(
                            tagged_body_turn(purpose, n, w, b, s)
                        ),
                    )


def stored(path: Path) -> dict[str, Row]:
    """Rows read before, by key; an unfinished last line is ignored."""
    rows: dict[str, Row] = {}
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        rows[row["key"]] = row
    return rows


def run(arguments: argparse.Namespace) -> None:
    """Read what is missing until the time is up."""
    path = arguments.work / f"{arguments.what}-{arguments.purpose}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    known = stored(path)
    until = time.monotonic() + arguments.seconds
    with path.open("a") as file:
        for key, work in tasks(arguments):
            if key in known:
                continue
            if time.monotonic() > until:
                print(f"{path}: stopped before {key}; run it again to continue")
                return
            file.write(json.dumps({"key": key, **work()}) + "\n")
            file.flush()
    print(f"{path}: complete")


def write(arguments: argparse.Namespace) -> None:
    """Make the shipped calibration of the turns of the purpose "calibrate"."""
    rows = stored(arguments.work / "null-calibrate.jsonl")
    numbers = sorted(int(key) for key in rows)
    if numbers != list(range(len(numbers))):
        raise SystemExit("turns are missing: continue `null --purpose calibrate` first")
    scores = sorted((row["largest"] for row in rows.values() if row["largest"] is not None), reverse=True)
    first = FIRST["calibrate"]
    made = EndingCalibration(
        STATEMENT, (first, first + len(rows)), LOOKS, FEWEST_VIEWS, len(rows), tuple(scores)
    )
    CALIBRATION.write_text(made.to_json())
    print(f"{CALIBRATION}: {made.turns} turns, scores {made.scores[:10]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("null", "whole", "tags", "speed", "bodies", "write", "report"))
    parser.add_argument("--purpose", choices=tuple(FIRST), default="choose")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after this time")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "until-sure", help="results folder")
    arguments = parser.parse_args()
    if arguments.what == "write":
        write(arguments)
    elif arguments.what == "report":
        from until_sure_report import document

        rows = {
            name: list(stored(arguments.work / f"{name}-report.jsonl").values())
            for name in ("null", "whole", "tags", "speed", "bodies")
        }
        page = document(rows, EndingCalibration.shipped())
        (ROOT / "docs" / "results" / "until-sure.md").write_text(page)
        print(page)
    else:
        run(arguments)


if __name__ == "__main__":
    main()
