"""The rates of the reader that `tagid plan` interpolates, by body, views and SNR.

Bare tags are scenes of `identification_scenes.py` with the paper's four layouts; tags on bodies are those of
`reading_bodies_scenes.py`, 36 views per turn, with nothing enrolled and with the untagged body enrolled from
three captures. Offsets from the axis and pulses are taken in turn. Per cent with 95 % Wilson intervals.

    python -m tests.benchmarks planning-rates --jobs 2 --write docs/results

Every reading becomes a line of --keep, so that a run can be stopped and continued. With --write it makes
`tagid/planning/rates.json`, too, whose sources name the page.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tagid.errors import TagidError
from tagid.pipeline.identify import aspect_spectra, identify
from tagid.planning.rates import Measured
from tagid.proportion import wilson
from tagid.tags.bodies.joint import Named, enroll_signature
from tagid.tags.bodies.signature import Signature
from tests.benchmarks import identification_scenes as bare_scenes
from tests.benchmarks import reading_bodies_scenes as body_scenes
from tests.benchmarks.provenance import ROOT, commit, page, publish

RATES = ROOT / "tagid" / "planning" / "rates.json"
PAGE = "planning-rates.md"
FIRST_BARE, FIRST_BODY = 2000, 700
"""Numbers of scenes that no other benchmark reads."""
SNRS_DB = (20, 10, 5, 0)
BARE_VIEWS, BODY_VIEWS = (36, 18, 12), 36
TITLES = {"none": "Bare tags", "bodies": "Tags on bodies", "enrolled": "Tags on enrolled bodies"}
CELLS = tuple(product(body_scenes.OFFSETS_MM, body_scenes.PULSES))


@dataclass(frozen=True)
class Task:
    """One reading of a tagged object.

    Attributes:
        mode: one of TITLES.
        body, views, snr_db: a row of the table.
        number: of its scenes.
    """

    mode: str
    body: str
    views: int
    snr_db: int
    number: int

    @property
    def key(self) -> str:
        """In the file of --keep."""
        return "/".join(map(str, asdict(self).values()))


def tasks(bare: int, rounds: int) -> Iterator[Task]:
    """All readings, in the order of the tables."""
    for views, snr, number in product(BARE_VIEWS, SNRS_DB, range(bare)):
        yield Task("none", "none", views, snr, number)
    bodies = [body for body in body_scenes.BODIES if body != "none"]
    for mode, body, snr in product(("bodies", "enrolled"), bodies, SNRS_DB):
        for number in range(rounds * len(CELLS)):
            yield Task(mode, body, BODY_VIEWS, snr, number)


def outcome(task: Task) -> str:
    """Named, wrong or refused."""
    try:
        return _named(task)
    except TagidError:
        return "refused"


def _named(task: Task) -> str:
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
        drawn = body_scenes.draw(cell, "development", FIRST_BODY + turn)
        capture, name, layouts = drawn.capture, drawn.name, drawn.layouts
        if task.mode == "enrolled":
            shown = body_scenes.enrolment_captures(cell, "development", FIRST_BODY + turn, tagged=False)
            captures = [Named(f"capture {i}", aspect_spectra(base)) for i, base in enumerate(shown)]
            signatures = [enroll_signature(captures, "body", "body").signature]
    answer = identify(capture, layouts, signatures=signatures)
    if answer.status != "identified" or answer.reading is None:
        return "refused"
    return "named" if answer.reading.layout == name else "wrong"


def rows(outcomes: dict[Task, str]) -> list[Measured]:
    """The rows of the tables."""
    made = []
    for key in dict.fromkeys((t.mode, t.body, t.views, t.snr_db) for t in outcomes):
        matching = [o for t, o in outcomes.items() if (t.mode, t.body, t.views, t.snr_db) == key]
        mode, body, views, snr_db = key
        counts = len(matching), matching.count("named"), matching.count("wrong")
        made.append(Measured(body, views, float(snr_db), *counts, enrolled=mode == "enrolled"))
    return made


def table(mode: str, outcomes: dict[Task, str]) -> list[str]:
    """The section of a mode."""
    lines = [f"## {TITLES[mode]}", "", "| body | views | SNR dB | scenes | named | wrong |", "|---" * 6 + "|"]
    for row in rows({task: base for task, base in outcomes.items() if task.mode == mode}):
        cells = [row.body, str(row.views), f"{row.snr_db:g}", str(row.scenes)]
        for count in (row.named, row.wrong):
            interval = wilson(count / row.scenes, row.scenes)
            share, low, high = (100 * rate for rate in (count / row.scenes, interval.low, interval.high))
            cells.append(f"{share:.1f} ({low:.1f}..{high:.1f})")
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def add_options(parser: argparse.ArgumentParser) -> None:
    """How many scenes, beside the options of every benchmark."""
    parser.add_argument("--bare", type=int, default=100, help="scenes a row of bare tags")
    parser.add_argument("--rounds", type=int, default=2, help="rounds of tags on bodies, 8 scenes a row each")
    parser.add_argument("--modes", nargs="*", choices=tuple(TITLES), default=tuple(TITLES))
    parser.add_argument("--most", type=int, help="only the first so many readings, for a check")


def rates(given: argparse.Namespace) -> None:
    """Read, print, and write the page and the rates."""
    work = given.keep or ROOT / "build" / "planning-rates.jsonl"
    if given.quick and given.most is None:
        given.most = 3
    work.parent.mkdir(parents=True, exist_ok=True)
    lines = work.read_text().splitlines() if work.is_file() else []
    known = dict(json.loads(line) for line in lines)
    wanted = [task for task in tasks(given.bare, given.rounds) if task.mode in given.modes][: given.most]
    missing = [task for task in wanted if task.key not in known]
    with multiprocessing.get_context("fork").Pool(given.jobs) as pool, work.open("a") as file:
        for task, base in zip(missing, pool.imap(outcome, missing), strict=True):
            known[task.key] = base
            file.write(json.dumps([task.key, base]) + "\n")
            file.flush()
    outcomes = {task: known[task.key] for task in wanted}
    seeds = f"numbers from {FIRST_BARE} (bare tags) and from {FIRST_BODY} (bodies, development) on"
    at = commit()  # before the page and the rates change the tree
    text = page("Rates of the reader, for `tagid plan`", seeds, __doc__)
    for mode in given.modes:
        text += table(mode, outcomes)
    publish(text, given.write, PAGE)
    if given.write:
        sources = {mode: f"docs/results/{PAGE}, {title}, commit {at}" for mode, title in TITLES.items()}
        made = {"format": 1, "sources": sources, "rows": [asdict(row) for row in rows(outcomes)]}
        RATES.write_text(json.dumps(made, indent=1) + "\n")
        print(f"{RATES.relative_to(ROOT)} written")


if __name__ == "__main__":
    from tests.benchmarks.__main__ import main

    sys.argv[:1] = [str(Path(__file__).with_name("__main__.py")), "planning-rates"]
    sys.exit(main())
