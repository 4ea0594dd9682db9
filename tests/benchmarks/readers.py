"""How often the reader names tags rightly, and other objects at all, on every yardstick.

Each yardstick of `readers_scenes.py` is a set of simulated or solved recordings of development seeds, read by
`tagid.reading.reader.read` as the commands do, with the default settings. A tagged object is right where the
name is that of its layout; "others" carry no enrolled tag, so that every name is wrong. "rules (before)" are
the stored answers to the same scenes of the reader that this one replaced (answers_of_the_rules.jsonl, keyed
by scene); its columns count the scenes that it had read. Intervals are 95 % (Wilson), in per cent. Seconds
are of the processor, on one core.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tagid.errors import TagidError
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.reading.reader import read
from tests.benchmarks.measure import timed
from tests.benchmarks.readers_scenes import SEEDS, YARDSTICKS, drawn
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, column, counted

RULES = Path(__file__).with_name("answers_of_the_rules.jsonl")
COUNTS = "tagged | right | wrong | others | named"
Answer = dict[str, Any]
"""group, truth and outcome (right, wrong, or the code of what was answered instead of a name) of a scene; the
name that was given, the lead of the likeliest layout, nats, and the seconds of the processor."""


def answered(job: tuple[str, int, str]) -> Answer:
    """The reader's answer to a scene of a yardstick, a round and a key; empty if there is no such scene."""
    yardstick, turn, key = job
    scene = drawn(yardstick, turn)[key]()
    if scene is None:
        return {}
    scans = preprocess(scene.capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
    given: Answer = {"group": scene.group, "truth": scene.truth, "name": None, "lead": None}

    def outcome() -> str:
        try:
            reading = read(scans, scene.layouts, signatures=scene.signatures)
        except TagidError as error:
            return f"failed: {error.code}"
        given["lead"] = round(reading.lead, 2)
        if reading.status != "identified":
            return reading.code.value or reading.status
        given["name"] = reading.layout
        right = scene.truth is not None and reading.layout in (scene.truth, scene.alias)
        return "right" if right else "wrong"

    said, _, seconds = timed(outcome)
    return {**given, "outcome": said, "seconds": round(seconds, 2)}


def table(yardstick: str, answers: dict[str, Answer], before: dict[str, Answer], missing: int) -> Table:
    """Groups against readers: of tagged scenes right and wrong, of others how many were named."""
    rows = []
    for group in (*sorted({a["group"] for a in answers.values()}), "all"):
        matching = {key: a for key, a in answers.items() if group in (a["group"], "all")}
        earlier = [before[key] for key in matching if key in before]
        rows.append((group, *_cells([*matching.values()]), *_cells(earlier)))
    seconds = column(answers.values(), "seconds") if answers else np.zeros(1)
    middle, late = np.quantile(seconds, [0.5, 0.95])
    below = f"Seconds of a reading: median {middle:.2f}, 95 % under {late:.2f}, most {seconds.max():.2f}."
    if missing:
        below += f"\n\n{missing} scenes left out: not solved, or drawn as foreign and an enrolled pair."
    words = " ".join(str(YARDSTICKS[yardstick].__doc__).split())
    return Table(
        f"scenes | {COUNTS} | rules (before): {COUNTS}",
        rows,
        f"## {yardstick}\n\n{words}",
        below=below,
        whole=True,
    )


def _cells(some: Sequence[Answer]) -> list[object]:
    tagged = [a["outcome"] for a in some if a["truth"] is not None]
    others = [a["outcome"] for a in some if a["truth"] is None]
    first = len(tagged), counted(tagged.count("right"), len(tagged)), tagged.count("wrong")
    return [*first, len(others), counted(others.count("wrong"), len(others))]


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("yardsticks", nargs="*", choices=[*YARDSTICKS, []], help="default: all")
    parser.add_argument("--rounds", type=int, default=1, help="rounds of scenes, each of other seeds")


def names(run: Run) -> Iterator[Table]:
    """A table for every yardstick; --seeds takes so many scenes of each."""
    run.seeds = SEEDS
    before = {row["key"]: row for row in map(json.loads, RULES.read_text().splitlines())}
    yield Table((), (), str(__doc__).split("\n\n", 1)[1])
    for yardstick in run.options.yardsticks or YARDSTICKS:
        jobs = [
            (yardstick, turn, key) for turn in range(run.options.rounds) for key in drawn(yardstick, turn)
        ]
        results = run.each(answered, jobs[: 3 if run.quick and run.scenes is None else run.scenes])
        answers = {key: answer for (_, _, key), answer in results.items() if answer}
        yield table(yardstick, answers, before, len(results) - len(answers))
