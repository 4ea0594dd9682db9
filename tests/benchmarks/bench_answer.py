"""Time from the last scan to the answer: 36 views, four layouts, nothing enrolled, without torch.

Tags are those of `reading_bodies_scenes.py` on every body at 20 and 10 dB, up to 10 mm off the axis; the
others are drawn from the population on which `tags.false_accept` rests (`train.population`): untagged bodies,
and foreign tags on them. A recording is prepared and read as `tagid scan` does it, once everything is loaded;
of two readings the faster counts. Causes are looked for where nothing is named; `tagid scan --live` shows the
answer before that. Times are of the wall clock; BLAS may use both cores.

    python tests/benchmarks/bench_answer.py --write docs/results
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import reading_bodies_scenes as scenes
from provenance import page, publish

from tagid.capture import Capture
from tagid.pipeline.diagnosis import with_causes
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.tags.layouts.layout import builtin_layouts
from train.population import draw

NUMBER = 980
FIRST = 4_400_000
VIEWS = 36
LIMIT_S = 1.0


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


def row(name: str, found: list[Timed]) -> str:
    """Of the table."""
    answer, whole = np.array([[one.answer_s, one.whole_s] for one in found]).T
    cells = [name, str(len(found)), str(sum(one.named for one in found))]
    for seconds in (answer, whole):
        middle, most = np.median(seconds), seconds.max()
        cells.append(f"{middle:.2f} | {np.quantile(seconds, 0.95):.2f} | {most:.2f}")
        cells.append(f"{100 * np.mean(seconds > LIMIT_S):.0f} %")
    return f"| {' | '.join(cells)} |"


def document(found: list[Timed]) -> list[str]:
    """The table."""
    times = "median (s) | 95 % | most | over 1 s"
    lines = [f"| recording | number | named | answer: {times} | with causes: {times} |", "|---" * 11 + "|"]
    for group in dict.fromkeys(one.group for one in found):
        lines.append(row(group, [one for one in found if one.group == group]))
    lines.append(row("named", [one for one in found if one.named]))
    lines.append(row("not named", [one for one in found if not one.named]))
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--others", type=int, default=120, help="objects without an enrolled tag")
    parser.add_argument("--write", type=Path, help="folder for time-to-answer.md")
    given = parser.parse_args()
    if "torch" in sys.modules:
        sys.exit("torch is loaded: an answer must not need it")
    timed("", next(captures(0))[1])
    found = [timed(group, capture) for group, capture in captures(given.others)]
    title = "Time from the last scan to the answer"
    seeds = f"development, number {NUMBER}; {FIRST:,} to {FIRST + given.others - 1:,}"
    lines = [*page(title, seeds, __doc__), *document(found)]
    publish(lines, given.write, "time-to-answer.md")


if __name__ == "__main__":
    main()
