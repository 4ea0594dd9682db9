"""The page of `until_sure.py`: false names, the share of a turn that is needed, and errors."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from provenance import commit

from tagid.proportion import wilson
from tagid.reading.ending import EndingCalibration
from tagid.reading.looks import LOOKS, SPENT, Look, agreed

FALSE_ACCEPT = 1e-3
Row = dict[str, Any]


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

    def outcome(self, name: str) -> str:
        """ "correct", "ambiguous", "refused" or "wrong"."""
        return outcome_of(self.status, self.layout or "", name)


def outcome_of(status: str, answer: str, name: str) -> str:
    """An answer against the right name, "" for none. Naming anything where no name is right is wrong."""
    if status == "identified":
        return "correct" if name and answer == name else "wrong"
    return "ambiguous" if status == "ambiguous" else "refused"


def share(hits: int, total: int) -> str:
    """Per cent with its interval."""
    interval = wilson(hits / total, total)
    return f"{100 * hits / total:.1f} ({100 * interval.low:.1f}..{100 * interval.high:.1f})"


def ended(row: Row, calibration: EndingCalibration) -> Ended:
    """The ending of a turn of `tags`, `speed` or `bodies`, by the rule of `tagid.live.sure`."""
    for count in range(2, len(LOOKS) + 1):
        looks = looks_of(row)[:count]
        name, _ = agreed(looks)
        if name is not None and may_end(looks, calibration):
            return Ended(LOOKS[count - 1], "identified", name)
    return Ended(1.0, row["rest"]["status"], row["rest"]["layout"])


def looks_of(row: Row) -> list[Look]:
    """The looks of a row."""
    return [
        Look(one["share"], one["views"], one["layout"], -math.inf if one["score"] is None else one["score"])
        for one in row["looks"]
    ]


def may_end(looks: Sequence[Look], calibration: EndingCalibration) -> bool:
    """Whether the calibration bears out an ending after these looks."""
    bound = calibration.bound(looks, FALSE_ACCEPT)
    return bound.reachable and bound.kept


def falsely_ended(row: Row, calibration: EndingCalibration) -> bool:
    """Whether a null turn ends early with a name."""
    if len(row["looks"]) < len(LOOKS):
        return False
    looks = looks_of(row)
    pairs = [looks[:count] for count in range(2, len(LOOKS) + 1)]
    return any(agreed(pair)[0] is not None and may_end(pair, calibration) for pair in pairs)


HEAD = """# Ending a scan when the answer is certain

- Command: `python tests/benchmarks/until_sure.py` with `null` and `whole` (`--first 2000`), `tags`, `speed`
  and `bodies`, each with `--purpose report`, then `report`
- Commit: {commit}
- Machine: {machine}, {cores} cores, Python {python}, numpy {numpy}, busy with other programs
- Date: {date}
- Seeds: numbers from 3 000 000 on for this page, {first} to {last} for the calibration, from 1 000 000 on for
  the choice of score and looks (`tests/benchmarks/until_sure_scenes.py`). The looks were first at 30, 45 and
  70 %, and layouts of two reflectors could end a scan, too; both were changed after 2,000 turns of the
  calibration and 2,000 of the report (numbers 0 to 1,999, not used here) had been seen
- Turns: {counts}

`tagid scan --until-sure` reads the scans at {looks} % of the turn. It ends the scan when two successive
looks name the same layout without a body, with a lead that at most a share of {early:g} of turns without
an enrolled tag reaches anywhere in the turn. Otherwise the whole turn is recorded, and its name has the rest
of `tags.false_accept` ({stated:g}). Per cent with 95 % Wilson intervals.

The calibration holds {turns} turns: {population}. {named} of them were named at two successive looks, with
leads of {scores} nats.
"""
WHOLE = """
The whole turn, read for {count} of them: named with the part of the error that early
endings leave {rest}, with all of it {every}.
"""
SPEED = """\
The paper's four layouts, 10 dB, 36 views per turn. The whole turn is read with the same wrong angles here;
`tagid scan` corrects them by the repetition of the scans after a whole turn.
"""
BODIES = """\
20 and 10 dB, 36 views per turn, 0 to 10 mm off the axis. Names on a body have no calibration for a part of
a turn, so such scans run the whole turn.
"""


def head(rows: dict[str, list[Row]], calibration: EndingCalibration) -> str:
    """What was run, and where."""
    return HEAD.format(
        commit=commit(),
        machine=platform.machine(),
        cores=os.cpu_count(),
        python=platform.python_version(),
        numpy=np.__version__,
        date=f"{datetime.now(UTC):%Y-%m-%d}",
        first=calibration.seeds[0],
        last=calibration.seeds[1] - 1,
        counts=", ".join(f"{len(own)} {name}" for name, own in rows.items()),
        looks=", ".join(f"{100 * one:.0f}" for one in LOOKS),
        early=SPENT * FALSE_ACCEPT,
        stated=FALSE_ACCEPT,
        turns=calibration.turns,
        population=calibration.population,
        named=len(calibration.scores),
        scores=_scores(calibration),
    )


def _scores(calibration: EndingCalibration) -> str:
    return ", ".join(f"{score:.1f}" for score in calibration.scores[:8]) or "-"


def nulls(rows: list[Row], whole: list[Row], calibration: EndingCalibration) -> list[str]:
    """False names by kind."""
    lines = [
        "## Turns without an enrolled tag",
        "",
        "Ended early: the scan would have ended with a name.",
        "",
        "| object | turns | named at one look | ended early |",
        "|---|---|---|---|",
    ]
    kinds = sorted({row["kind"] for row in rows})
    for kind in [*kinds, "all"]:
        own = [row for row in rows if kind in (row["kind"], "all")]
        named = sum(row["looks"][len(row["looks"]) // 2]["layout"] is not None for row in own)
        early = sum(falsely_ended(row, calibration) for row in own)
        lines.append(f"| {kind} | {len(own)} | {share(named, len(own))} | {share(early, len(own))} |")
    if whole:
        rest = sum(row["rest"]["status"] == "identified" for row in whole)
        every = sum(row["whole"]["status"] == "identified" for row in whole)
        lines.append(
            WHOLE.format(
                count=len(whole), rest=share(rest, len(whole)), every=share(every, len(whole))
            ).rstrip()
        )
        lines += [
            f"- {row['kind']}, {row['views']} views, {row['snr_db']:g} dB: {row['whole']['layout']} "
            f"({row['whole']['kind']})"
            for row in whole
            if row["whole"]["status"] == "identified"
        ]
    return [*lines, ""]


def outcomes(
    title: str,
    column: str,
    rows: list[Row],
    key: Callable[[Row], str],
    calibration: EndingCalibration,
) -> list[str]:
    """Share of the turn and errors, against the whole turn in the same run."""
    lines = [
        f"## {title}",
        "",
        f"| {column} | turns | ended early | share of the turn, median | 90 % | correct | wrong | refused | "
        "whole turn: correct | wrong | refused |",
        "|" + "---|" * 11,
    ]
    for name in dict.fromkeys(key(row) for row in rows):
        own = [row for row in rows if key(row) == name]
        found = [ended(row, calibration) for row in own]
        shares = np.array([one.share for one in found])
        mine = [one.outcome(row["name"]) for one, row in zip(found, own, strict=True)]
        theirs = [
            outcome_of(row["whole"]["status"], row["whole"]["layout"] or "", row["name"]) for row in own
        ]
        cells = [share(int((shares < 1).sum()), len(own))]
        cells += [f"{np.quantile(shares, q, method='higher'):.2f}" for q in (0.5, 0.9)]
        for each in (mine, theirs):
            wrong, right = each.count("wrong"), each.count("correct")
            cells += [share(right, len(own)), str(wrong), str(len(own) - right - wrong)]
        lines.append(f"| {name} | {len(own)} | {' | '.join(cells)} |")
    return [*lines, ""]


def document(rows: dict[str, list[Row]], calibration: EndingCalibration) -> str:
    """The page.

    Args:
        rows: of "null", "whole", "tags", "speed" and "bodies".
        calibration: the shipped one.
    """
    lines = [head(rows, calibration), *nulls(rows["null"], rows["whole"], calibration)]
    if rows["tags"]:
        tags = sorted(rows["tags"], key=lambda row: (row["enrolled"] != "paper", -row["snr_db"]))
        lines += outcomes(
            "Tags without a body",
            "enrolled, SNR dB",
            tags,
            lambda row: f"{row['enrolled']}, {row['snr_db']:g}",
            calibration,
        )
        lines += ["36 views per turn; scenes of `tests/benchmarks/identification_scenes.py`.", ""]
    if rows["speed"]:
        lines += outcomes(
            "A stated speed that is not exact",
            "angles too large by",
            rows["speed"],
            lambda row: f"{100 * (row['scale'] - 1):+.0f} %",
            calibration,
        )
        lines.append(SPEED)
    if rows["bodies"]:
        lines += outcomes(
            "Tags on bodies",
            "scenes, body",
            sorted(rows["bodies"], key=lambda row: row["kind"]),
            lambda row: row["kind"],
            calibration,
        )
        lines.append(BODIES)
    return "\n".join(lines).rstrip() + "\n"
