"""The rates of the reader that `tagid plan` interpolates, by body, views and SNR.

Bare tags are scenes of `identification_scenes.py` with the paper's four layouts; tags on bodies are those of
`reading_bodies_scenes.py`, 36 views per turn, with nothing enrolled and with the untagged body enrolled from
three captures. Offsets from the axis and pulses are taken in turn. Per cent with 95 % Wilson intervals.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import product
from typing import NamedTuple

from tagid.errors import TagidError
from tagid.planning.rates import Measured
from tagid.tags.bodies.signature import Signature
from tests.benchmarks import identification_scenes as bare_scenes
from tests.benchmarks import reading_bodies_scenes as body_scenes
from tests.benchmarks.provenance import ROOT, commit
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, grouped, share

RATES = ROOT / "tagid" / "planning" / "rates.json"
FIRST_BARE, FIRST_BODY = 2000, 700
"""Numbers of scenes that no other benchmark reads."""
SNRS_DB = (20, 10, 5, 0)
BARE_VIEWS, BODY_VIEWS = (36, 18, 12), 36
TITLES = {"none": "Bare tags", "bodies": "Tags on bodies", "enrolled": "Tags on enrolled bodies"}
CELLS = tuple(product(body_scenes.OFFSETS_MM, body_scenes.PULSES))


class Task(NamedTuple):
    """One reading of a tagged object: one of TITLES, a row of its table, and the number of the scene."""

    mode: str
    body: str
    views: int
    snr_db: int
    number: int


def tasks(bare: int, rounds: int) -> Iterator[Task]:
    for views, snr, number in product(BARE_VIEWS, SNRS_DB, range(bare)):
        yield Task("none", "none", views, snr, number)
    bodies = [body for body in body_scenes.BODIES if body != "none"]
    for mode, body, snr in product(("bodies", "enrolled"), bodies, SNRS_DB):
        for number in range(rounds * len(CELLS)):
            yield Task(mode, body, BODY_VIEWS, snr, number)


def outcome(task: Task) -> dict[str, str]:
    signatures: Sequence[Signature] = ()
    if task.mode == "none":
        condition = bare_scenes.Condition("tagged", "paper", task.views, task.snr_db)
        recorded = bare_scenes.record(condition, FIRST_BARE + task.number)
        capture, name, layouts = recorded.capture, recorded.name, bare_scenes.SETS["paper"]
    else:
        turn, at = divmod(task.number, len(CELLS))
        offset_mm, pulse = CELLS[at]
        cell = body_scenes.Cell(
            "own", "tagged", "paper", task.body, offset_mm, task.snr_db, task.views, pulse
        )
        capture, layouts, name = body_scenes.draw(cell, FIRST_BODY + turn)
        if task.mode == "enrolled":
            try:
                signatures = [body_scenes.signature_of(cell, FIRST_BODY + turn, "body", "body")]
            except TagidError:
                return {"outcome": "refused"}
    return {"outcome": bare_scenes.outcome_of(capture, layouts, name, signatures)}


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--bare", type=int, default=100, help="scenes a row of bare tags")
    parser.add_argument("--rounds", type=int, default=2, help="rounds of tags on bodies, 8 scenes a row each")


def rates(run: Run) -> Iterator[Table]:
    """A table for every mode; with --write `tagid/planning/rates.json`, too, whose sources name the page."""
    run.seeds = f"numbers from {FIRST_BARE} (bare tags) and from {FIRST_BODY} (bodies, development) on"
    yield Table((), (), str(__doc__).split("\n\n", 1)[1])
    jobs = list(tasks(run.options.bare, run.options.rounds))
    at = commit()  # before the page and the rates change the tree
    results = run.each(outcome, jobs[:3] if run.quick else jobs)
    made: dict[str, list[Measured]] = {mode: [] for mode in TITLES}
    for (mode, body, views, snr_db), some in grouped(results, lambda task: task[:4]).items():
        said = [item["outcome"] for item in some]
        counts = len(said), said.count("named"), said.count("wrong")
        made[mode].append(Measured(body, views, float(snr_db), *counts, enrolled=mode == "enrolled"))
    for mode, rows in made.items():
        cells = [
            (r.body, r.views, f"{r.snr_db:g}", r.scenes, share(r.named, r.scenes), share(r.wrong, r.scenes))
            for r in rows
        ]
        columns = "body | views | SNR dB | scenes | named | wrong"
        yield Table(columns, cells, f"## {TITLES[mode]}", whole=True)
    if run.pictures:
        at = min(run.commits, default=at)
        sources = {
            mode: f"docs/results/planning-rates.md, {title}, commit {at}" for mode, title in TITLES.items()
        }
        rows = [asdict(row) for some in made.values() for row in some]
        RATES.write_text(json.dumps({"format": 1, "sources": sources, "rows": rows}, indent=1) + "\n")
        run.say(f"{RATES.relative_to(ROOT)} written")
