"""Calibrate the reader: leads of objects that carry no enrolled tag, by the function that answers.

Run `python -m train.calibrate --first 320000 --count 1000 --views 12 --jobs 2 --rows rows.jsonl` for every
stratum, as often and on as many machines as wanted, then `python -m train.calibrate --write
tagid/reading/calibration.json rows.jsonl ..` to make the file that the package ships. Seeds from SEALED on
are not for this.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final, TypedDict

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tagid import processes
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.reading.calibration import Calibration, Stratum, largest, worth
from tagid.reading.decision import decide
from tagid.reading.place import settled
from tagid.reading.reader import contest
from tagid.tags.layouts.layout import builtin_layouts
from train.population import STATEMENT, draw

SEALED: Final = 9_000_000
"""Seeds from here on are drawn once, for the report."""
VIEWS: Final = (12, 18, 24, 361)
"""Limits of the strata."""
LONGEST_GAP: Final = 1000
"""Seeds farther apart belong to two runs."""


class Row(TypedDict):
    """An object that carries no enrolled tag, and what the lead of its likeliest layout counts, nats."""

    seed: int
    views: int
    lead: float


def lead_of(seed: int, views: Sequence[int] = ()) -> Row | None:
    """The row of a seed; None for what was drawn as a foreign object and is an enrolled pair.

    Args:
        views: of the objects, in turn; none: as drawn.
    """
    specimen = draw(seed, views=views[seed % len(views)] if views else None)
    if specimen.is_enrolled_pair:
        return None
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    scans = preprocess(specimen.capture, settings=settings)
    known = contest(scans, list(builtin_layouts().values()))
    decision = decide(settled(known).hypotheses)
    return Row(seed=seed, views=specimen.views, lead=worth(decision.lead, decision.bare))


def strata(rows: Sequence[Row], views: Sequence[int] = VIEWS) -> tuple[Stratum, ...]:
    """The rows by views."""
    groups = []
    for low, high in pairwise(views):
        leads = [row["lead"] for row in rows if low <= row["views"] < high]
        groups.append(Stratum(low, high, len(leads), largest(leads)))
    return tuple(groups)


def ranges(seeds: list[int]) -> tuple[tuple[int, int], ...]:
    """[first, last) of every run of seeds."""
    starts = [0, *(i for i, (a, b) in enumerate(pairwise(seeds), 1) if b - a > LONGEST_GAP), len(seeds)]
    return tuple((seeds[a], seeds[b - 1] + 1) for a, b in pairwise(starts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="rows to make the calibration of")
    parser.add_argument("--write", type=Path, help="calibration file to write")
    parser.add_argument("--first", type=int, default=320_000)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument(
        "--views", type=int, nargs="*", default=(), help="of the objects, in turn; else drawn"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--rows", type=Path, default=Path("rows.jsonl"))
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.count)
    if any(seed >= SEALED for seed in seeds):
        parser.error(f"seeds from {SEALED} on are sealed")
    if arguments.count:
        lead = partial(lead_of, views=tuple(arguments.views))
        with processes.spawn_context().Pool(arguments.jobs) as pool, arguments.rows.open("a") as file:
            for row in pool.imap_unordered(lead, seeds, chunksize=4):
                if row is not None:
                    file.write(json.dumps(row) + "\n")
                    file.flush()
    if arguments.write:
        rows: dict[int, Row] = {}
        for path in arguments.files:
            known: list[Row] = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
            rows |= {row["seed"]: row for row in known}
        made = Calibration(STATEMENT, ranges(sorted(rows)), strata(list(rows.values())))
        arguments.write.write_text(made.to_json(), "utf-8")


if __name__ == "__main__":
    main()
