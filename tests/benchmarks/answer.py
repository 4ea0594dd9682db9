"""Time from the last scan to the answer: 36 views, four layouts, nothing enrolled, without torch.

Tags are those of `reading_bodies_scenes.py` on every body at 20 and 10 dB, up to 10 mm off the axis; the
others are drawn from the population on which `tags.false_accept` rests (`train.population`): untagged bodies,
and foreign tags on them. A recording is prepared and read as `tagid scan` does it, once everything is loaded;
of two readings the faster counts. Causes are looked for where nothing is named; `tagid scan --live` shows the
answer before that. Times are of the wall clock, on one core.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from tagid.capture import Capture
from tagid.pipeline.diagnosis import with_causes
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.tags.layouts.layout import builtin_layouts
from tests.benchmarks import reading_bodies_scenes as scenes
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table
from train.population import draw

NUMBER = 980
FIRST = 4_400_000
VIEWS = 36
LIMIT_S = 1.0
METHOD = str(__doc__).split("\n\n", 1)[1].strip()


@dataclass(frozen=True)
class Timed:
    """Seconds until the answer, and until its causes.

    Attributes:
        group: row of the table.
        named: whether a layout is named.
        answer_s, whole_s: to the answer; with the search for causes.
    """

    group: str
    named: bool
    answer_s: float
    whole_s: float


def captures(others: int) -> Iterator[tuple[str, Capture]]:
    """Recordings, and the rows in which they are counted."""
    for body, snr, offset in product(scenes.BODIES, (20, 10), scenes.OFFSETS_MM):
        cell = scenes.Cell("own", "tagged", "paper", body, offset, snr, VIEWS, "nominal")
        name = "bare tag" if body == "none" else f"tag, {body}"
        yield name, scenes.draw(cell, "development", NUMBER).capture
    for seed in range(FIRST, FIRST + others):
        drawn = draw(seed, views=VIEWS)
        yield ("foreign tag" if len(drawn.positions) else "untagged"), drawn.capture


def timed(group: str, capture: Capture) -> Timed:
    """One recording."""
    layouts = list(builtin_layouts().values())
    answers, wholes = [], []
    for _ in range(2):
        start = time.perf_counter()
        prepared = PreparedCapture(load_capture(capture))
        answer = identify(prepared, layouts)
        answers.append(time.perf_counter() - start)
        with_causes(answer, prepared, layouts)
        wholes.append(time.perf_counter() - start)
    return Timed(group, answer.status == "identified", min(answers), min(wholes))


def row(name: str, timed: list[Timed]) -> tuple[object, ...]:
    """Of the table."""
    answer, whole = np.array([[item.answer_s, item.whole_s] for item in timed]).T
    cells: list[object] = [name, len(timed), sum(item.named for item in timed)]
    for seconds in (answer, whole):
        middle, late = np.median(seconds), np.quantile(seconds, 0.95)
        cells += [
            f"{middle:.2f}",
            f"{late:.2f}",
            f"{seconds.max():.2f}",
            f"{100 * np.mean(seconds > LIMIT_S):.0f} %",
        ]
    return tuple(cells)


def add_options(parser: argparse.ArgumentParser) -> None:
    """How many recordings."""
    parser.add_argument("--others", type=int, help="objects without an enrolled tag; 120, or 4 for a look")


def answers(run: Run) -> Iterator[Table]:
    """Seconds until the answer, and until its causes, by what was recorded."""
    assert "torch" not in sys.modules, "an answer must not need torch"
    others = run.options.others or (4 if run.quick else 120)
    run.seeds = f"development, number {NUMBER}; {FIRST:,} to {FIRST + others - 1:,}"
    timed("", next(captures(0))[1])
    results = []
    for i, (group, capture) in enumerate(captures(others)):
        if group.startswith(("bare", "tag,")) and run.quick and i % 16:
            continue
        results.append(timed(group, capture))
        run.say(f"{group}: {results[-1].answer_s:.2f} s")
    groups = {
        name: [item for item in results if item.group == name]
        for name in dict.fromkeys(o.group for o in results)
    }
    groups |= {
        "named": [item for item in results if item.named],
        "not named": [item for item in results if not item.named],
    }
    times = ("median (s)", "95 %", "most", "over 1 s")
    columns = (
        "recording",
        "number",
        "named",
        f"answer: {times[0]}",
        *times[1:],
        f"with causes: {times[0]}",
        *times[1:],
    )
    yield Table(columns, [row(name, some) for name, some in groups.items() if some], METHOD)
