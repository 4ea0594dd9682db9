"""How much of a turn `tagid scan --until-sure` needs, and how often it gives a false name.

It reads the scans at 45, 60 and 75 % of the turn, and ends the scan when two successive looks name the same
layout without a body, with a lead that at most a share of 0.3 of `tags.false_accept` of turns without an
enrolled tag reaches anywhere in the turn (`tagid/reading/ending.json`, of turns of the purpose "calibrate").
Otherwise the whole turn is recorded, and its name has the rest of the error. "choose" is for choosing
constants; nothing is chosen on the others.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from tagid.pipeline.identify import reader_settings
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings
from tagid.reading.ending import EndingCalibration
from tagid.reading.looks import LOOKS, SPENT, Look, agreed, largest, look, part_of_turn
from tagid.reading.reader import read
from tagid.reading.reading import Reading
from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, share
from tests.benchmarks.until_sure_scenes import (
    FIRST,
    STATEMENT,
    Turn,
    null_turn,
    tagged_body_turn,
    tagged_turn,
)

CALIBRATION = ROOT / "tagid" / "reading" / "ending.json"
FALSE_ACCEPT = 1e-3
FEWEST_VIEWS = 32
"""Views per turn that a scan needs: those of the calibration, less the error of their angle."""
FIRST_REPORTED = 2000
"""Null turns of the report below this were seen when the looks were changed."""
SNRS_DB = (20.0, 10.0, 5.0)
SETS = ("paper", "helmet-16")
SCALES = (0.95, 0.97, 1.03, 1.05)
BODIES = (("own", "none"), ("own", "can"), ("own", "cup"), ("own", "helmet"))
BODIES += (("full-wave", "none"), ("full-wave", "can"), ("full-wave", "helmet"))
Row = dict[str, Any]


class Null(NamedTuple):
    """A turn without an enrolled tag."""

    purpose: str
    number: int


class Tagged(NamedTuple):
    """A turn with a tag: alone, from a set of layouts, with angles wrong by a factor, or on a body."""

    purpose: str
    number: int
    group: str
    snr_db: float
    enrolled: str = "paper"
    scale: float = 1.0
    world: str = ""
    body: str = ""


def looks_at(turn: Turn, needed: Callable[[Look], bool]) -> list[Look]:
    """The looks at a turn; only the middle one where `needed` says that no other can matter."""
    middle = look(part_of_turn(turn.capture, LOOKS[1]), turn.layouts, LOOKS[1])
    if not needed(middle):
        return [middle]
    first, last = (look(part_of_turn(turn.capture, s), turn.layouts, s) for s in (LOOKS[0], LOOKS[2]))
    return [first, middle, last]


def _stored(look: Look) -> Row:
    """A look as JSON values."""
    return {**asdict(look), "score": look.score if math.isfinite(look.score) else None}


def _looks(row: Row) -> list[Look]:
    """The looks of a row."""
    return [
        Look(**{**look, "score": -math.inf if look["score"] is None else look["score"]})
        for look in row["looks"]
    ]


def read_null(task: Null) -> Row:
    """The looks at a null turn. Both pairs of looks contain the middle one, which often decides alone."""
    turn = null_turn(task.purpose, task.number)
    looks = looks_at(turn, lambda middle: middle.layout is not None)
    score = largest(looks) if len(looks) == len(LOOKS) else -math.inf
    kept = [_stored(look) for look in looks]
    return {"kind": turn.kind, "looks": kept, "largest": score if math.isfinite(score) else None}


def whole_turn(turn: Turn, spent: float) -> Reading:
    """What the reader says after the whole turn, where early looks have spent a share of the error."""
    settings = ImagingSettings(false_accept=FALSE_ACCEPT)
    scans = PreparedCapture(turn.capture, settings).scans(settings.preprocessing(False))
    return read(scans, turn.layouts, reader_settings(settings, spent))


def read_tagged(task: Tagged) -> Row:
    """All looks at a turn with a tag, and the whole turn."""
    if task.body:
        turn = tagged_body_turn(task.purpose, task.number, task.world, task.body, task.snr_db)
    else:
        turn = tagged_turn(task.purpose, task.number, task.enrolled, task.snr_db, task.scale)
    looks = looks_at(turn, lambda middle: True)
    every = whole_turn(turn, 0.0)
    rest = whole_turn(turn, SPENT) if every.status == "identified" else every
    answers = {key: [item.status, item.layout] for key, item in (("rest", rest), ("whole", every))}
    return {"name": turn.name, "looks": [_stored(look) for look in looks], **answers}


@dataclass(frozen=True)
class Ended:
    """How a scan of a turn ends with `--until-sure`.

    Attributes:
        share: of the turn that was needed; 1 without an early ending.
        status, layout: the answer.
    """

    share: float
    status: str
    layout: str | None


def outcome(status: str, layout: str | None, name: str) -> str:
    """An answer against the right name."""
    if status == "identified":
        return "correct" if layout == name else "wrong"
    return "refused"


def may_end(looks: Sequence[Look], calibration: EndingCalibration) -> bool:
    """Whether two looks agree and the calibration allows an ending after these."""
    bound = calibration.bound(looks, FALSE_ACCEPT)
    return agreed(looks)[0] is not None and bound.reachable and bound.kept


def ended(row: Row, calibration: EndingCalibration) -> Ended:
    """The ending of a turn with a tag, by the rule of `tagid.live.sure`."""
    for count in range(2, len(LOOKS) + 1):
        looks = _looks(row)[:count]
        if may_end(looks, calibration):
            return Ended(LOOKS[count - 1], "identified", agreed(looks)[0])
    return Ended(1.0, *row["rest"])


def null_table(rows: Sequence[Row], calibration: EndingCalibration) -> Table:
    """False names by kind."""

    def early(row: Row) -> bool:
        looks = _looks(row)
        return len(looks) == len(LOOKS) and any(
            may_end(looks[:n], calibration) for n in range(2, len(LOOKS) + 1)
        )

    lines = []
    for kind in (*sorted({row["kind"] for row in rows}), "all"):
        some = [row for row in rows if kind in (row["kind"], "all")]
        named = sum(row["looks"][len(row["looks"]) // 2]["layout"] is not None for row in some)
        ends = sum(map(early, some))
        lines.append((kind, len(some), share(named, len(some)), share(ends, len(some))))
    scores = ", ".join(f"{score:.1f}" for score in calibration.scores[:8]) or "none"
    note = (
        f"{__doc__.split(chr(10) * 2, 1)[1].strip()}\n\nThe calibration holds {calibration.turns} turns "
        f"(numbers {calibration.seeds[0]} to {calibration.seeds[1] - 1}): {calibration.population}. "
        f"{len(calibration.scores)} of them were named at two successive looks, with leads of {scores} "
        f"nats. Per cent with 95 % Wilson intervals.\n\nTurns without an enrolled tag; ended early: the "
        f"scan would have ended with a name."
    )
    return Table(("object", "turns", "named at one look", "ended early"), lines, note)


def tag_table(rows: dict[Tagged, Row], calibration: EndingCalibration) -> Table:
    """Share of the turn and errors, against the whole turn in the same run."""
    lines = []
    for group in dict.fromkeys(task.group for task in rows):
        some = [row for task, row in rows.items() if task.group == group]
        ends = [ended(row, calibration) for row in some]
        shares = np.array([end.share for end in ends])
        cells = [share(int((shares < 1).sum()), len(some))]
        cells += [f"{np.quantile(shares, q, method='higher'):.2f}" for q in (0.5, 0.9)]
        mine = [
            outcome(first.status, first.layout, row["name"]) for first, row in zip(ends, some, strict=True)
        ]
        for item in (mine, [outcome(*row["whole"], row["name"]) for row in some]):
            wrong, right = item.count("wrong"), item.count("correct")
            cells += [share(right, len(some)), str(wrong), str(len(some) - right - wrong)]
        lines.append((group, len(some), *cells))
    columns = (
        "turns with a tag", "turns", "ended early", "share of the turn, median", "90 %", "correct", "wrong",
        "refused", "whole turn: correct", "wrong", "refused",
    )  # fmt: skip
    note = (
        "Bare tags of two sets of layouts by SNR (36 views per turn; `identification_scenes.py`), with "
        "angles that are wrong by a factor (10 dB; `tagid scan` corrects them by the repetition of the "
        "scans after a whole turn), and on bodies (20 and 10 dB, 0 to 10 mm off the axis). Names on a body "
        "have no calibration for a part of a turn, so such scans run the whole turn."
    )
    return Table(columns, lines, note)


def tagged(purpose: str, count: int) -> list[Tagged]:
    """Turns with a tag, by the rows of the table."""
    numbers = range(count)
    tasks = [
        Tagged(purpose, n, f"{enrolled}, {snr:g} dB", snr, enrolled)
        for enrolled in SETS
        for snr in SNRS_DB
        for n in numbers
    ]
    tasks += [
        Tagged(purpose, n, f"angles {100 * (scale - 1):+.0f} %", 10.0, scale=scale)
        for scale in SCALES
        for n in numbers
    ]
    return tasks + [
        Tagged(purpose, n, f"{world} {body}", snr, world=world, body=body)
        for world, body in BODIES
        for snr in SNRS_DB[:2]
        for n in numbers
    ]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Whose turns."""
    parser.add_argument("--purpose", choices=tuple(FIRST), default="report")
    parser.add_argument("--nulls", type=int, help="turns without a tag; 2000, or 20 for a look")


def endings(run: Run) -> Iterator[Table]:
    """Turns without an enrolled tag, and with one."""
    purpose, count = run.options.purpose, run.number(14)
    nulls = run.options.nulls or (20 if run.quick else 2000)
    first = FIRST_REPORTED if purpose == "report" else 0
    at = FIRST[purpose]
    run.seeds = f"{at + first} to {at + first + nulls - 1} without a tag, {at} to {at + count - 1} with one"
    calibration = EndingCalibration.shipped()
    rows = run.each(read_null, [Null(purpose, n) for n in range(first, first + nulls)])
    yield null_table(list(rows.values()), calibration)
    tasks = tagged(purpose, count)
    yield tag_table(run.each(read_tagged, tasks[:: 6 if run.quick else 1]), calibration)


def calibrate(run: Run) -> Iterator[Table]:
    """Make `tagid/reading/ending.json` of turns of the purpose "calibrate" (with --write)."""
    turns = run.options.nulls or (20 if run.quick else 2000)
    first = FIRST["calibrate"]
    run.seeds = f"{first} to {first + turns - 1}"
    rows = run.each(read_null, [Null("calibrate", n) for n in range(turns)])
    scores = sorted((row["largest"] for row in rows.values() if row["largest"] is not None), reverse=True)
    made = EndingCalibration(STATEMENT, (first, first + turns), LOOKS, FEWEST_VIEWS, turns, tuple(scores))
    if run.pictures:
        CALIBRATION.write_text(made.to_json())
        run.say(f"{CALIBRATION.relative_to(ROOT)} written")
    yield Table(
        ("turns", "named at two successive looks", "leads, nats"), [(turns, len(scores), scores[:10])]
    )
