"""How often the reader names tags rightly, and other objects at all, on every yardstick.

Each yardstick of `readers_scenes.py` is a set of simulated or solved recordings of development seeds, read by
`tagid.reading.reader.read` as the commands do, with the default settings. A tagged object is right where the
name is that of its layout; "others" carry no enrolled tag, so that every name is wrong. "rules (before)" are
the stored answers to the same scenes of the reader that this one replaced (answers_of_the_rules.jsonl, keyed
by scene); its columns count the scenes that it had read. Intervals are 95 % (Wilson), in per cent. Seconds
are of the processor, on one core.

    python -m tests.benchmarks readers y1 y5 null --jobs 2
    python -m tests.benchmarks readers --jobs 2 --keep build/readers.jsonl --write docs/results

A run with --keep can be stopped and continued. --dump FOLDER writes each scene as a pickled dictionary,
FOLDER/YARDSTICK/NNNN.pkl, in an order of which every k-th is a fair sample; --bank FOLDER reads such files
instead of drawing the scenes.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from tagid.errors import TagidError
from tagid.proportion import wilson
from tagid.reading.reader import read
from tests.benchmarks.provenance import page, publish
from tests.benchmarks.readers_scenes import SEEDS, YARDSTICKS, drawn

RULES = Path(__file__).with_name("answers_of_the_rules.jsonl")
Prepared = dict[str, Any]
"""A scene with its scans: what `Scene.prepared` returns."""


@dataclass(frozen=True)
class Answer:
    """What became of one scene.

    Attributes:
        key, group, truth: of the scene.
        outcome: right, wrong, or the code of what was answered instead of a name.
        name: given, if any.
        seconds: of the processor.
        lead: of the likeliest layout, nats; None where there is none.
    """

    key: str
    group: str
    truth: str | None
    outcome: str
    name: str | None
    seconds: float
    lead: float | None = None


def answer(scene: Prepared) -> Answer:
    """The reader's answer to a scene."""
    start = time.process_time()
    lead, name = None, None
    try:
        reading = read(scene["scans"], scene["layouts"], signatures=scene["signatures"])
        outcome = reading.code.value or reading.status
        if math.isfinite(reading.lead):
            lead = round(reading.lead, 2)
    except TagidError as error:
        outcome = f"failed: {error.code}"
    else:
        if reading.status == "identified":
            name = reading.layout
            right = scene["truth"] is not None and name in (scene["truth"], scene["alias"])
            outcome = "right" if right else "wrong"
    seconds = round(time.process_time() - start, 2)
    return Answer(scene["key"], scene["group"], scene["truth"], outcome, name, seconds, lead)


class Answers:
    """Answers by scene; kept in a file if a path is given."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        lines = path.read_text().splitlines() if path and path.is_file() else []
        self.by_key = {row["key"]: Answer(**row) for row in map(json.loads, lines)}

    def add(self, answer: Answer) -> None:
        """Keep another one."""
        self.by_key[answer.key] = answer
        if self._path:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(json.dumps(asdict(answer)) + "\n")


@dataclass(frozen=True)
class Task:
    """A scene to be made, and what is to be done with it.

    Attributes:
        key: of the scene.
        make: draws or loads it; None where there is no such scene.
        path: of its dump; None for none.
        wanted: whether it is to be read.
    """

    key: str
    make: Callable[[], Prepared | None]
    path: Path | None
    wanted: bool


def prepared(draw: Callable[[], Any]) -> Prepared | None:
    """A drawn scene with its scans."""
    scene = draw()
    return None if scene is None else scene.prepared()


def load(path: Path) -> Prepared:
    """A dumped scene."""
    return pickle.loads(path.read_bytes())


def done(task: Task) -> tuple[bool, Answer | None]:
    """Whether there is such a scene, and the answer to it, if it is wanted."""
    scene = task.make()
    if scene is None:
        return False, None
    if task.path is not None:
        task.path.parent.mkdir(parents=True, exist_ok=True)
        part = task.path.with_suffix(".part")
        part.write_bytes(pickle.dumps(scene, protocol=5))
        part.rename(task.path)
    return True, answer(scene) if task.wanted else None


def tasks(yardstick: str, given: argparse.Namespace, kept: Answers) -> Iterator[Task]:
    """What is to be done for a yardstick; a scene that is dumped and answered has nothing to do."""
    if given.bank:
        paths = sorted((given.bank / yardstick).glob("*.pkl"))
        scenes = [(load(path)["key"], partial(load, path)) for path in paths]
    else:
        scenes = [(key, partial(prepared, draw)) for key, draw in drawn(yardstick, given.rounds)]
    for i, (key, make) in enumerate(scenes[: given.most]):
        path = given.dump / yardstick / f"{i:04d}.pkl" if given.dump else None
        path = None if path is None or path.exists() else path
        yield Task(key, make, path, key not in kept.by_key)


def share(count: int, total: int) -> str:
    """A count with the interval of its rate, per cent."""
    if not total:
        return "-"
    interval = wilson(count / total, total)
    return f"{count} ({100 * interval.low:.0f} to {100 * interval.high:.0f})"


def table(answers: Sequence[Answer], before: dict[str, Answer]) -> list[str]:
    """Groups against readers: of tagged scenes right and wrong, of others how many were named."""
    lines = [
        "| scenes | tagged | right | wrong | others | named | rules (before): tagged | right | wrong "
        "| others | named |",
        "|---" * 11 + "|",
    ]
    for group in (*sorted({a.group for a in answers}), "all"):
        cells = [group]
        matching = [a for a in answers if group in (a.group, "all")]
        for some in (matching, [before[a.key] for a in matching if a.key in before]):
            tagged = [a.outcome for a in some if a.truth is not None]
            others = [a.outcome for a in some if a.truth is None]
            cells += [str(len(tagged)), share(tagged.count("right"), len(tagged)), str(tagged.count("wrong"))]
            cells += [str(len(others)), share(others.count("wrong"), len(others))]
        lines.append("| " + " | ".join(cells) + " |")
    seconds = [a.seconds for a in answers] or [0.0]
    middle, late = np.quantile(seconds, [0.5, 0.95])
    words = f"Seconds of a reading: median {middle:.2f}, 95 % under {late:.2f}, most {max(seconds):.2f}."
    return [*lines, "", words]


def failures(answers: Sequence[Answer]) -> list[str]:
    """Each tagged scene that was not right, and each name of another."""
    return [
        f"- {a.key}: {a.truth or 'nothing'}, answered {a.outcome} {a.name or ''}".rstrip()
        for a in answers
        if a.outcome != "right" and (a.truth or a.outcome == "wrong")
    ]


def section(yardstick: str, given: argparse.Namespace, kept: Answers, before: Answers) -> list[str]:
    """The lines of a yardstick, whose scenes are read where no answer is kept."""
    todo = list(tasks(yardstick, given, kept))
    missing = 0
    with multiprocessing.get_context("fork").Pool(given.jobs) as pool:
        for there, item in pool.imap(done, [t for t in todo if t.path or t.wanted]):
            missing += not there
            if item is not None:
                kept.add(item)
    results = [kept.by_key[t.key] for t in todo if t.key in kept.by_key]
    words = " ".join(str(YARDSTICKS[yardstick].__doc__).split())
    lines = [f"## {yardstick}", "", words, "", *table(results, before.by_key)]
    if missing:
        lines.append(f"\n{missing} scenes left out: not solved, or drawn as foreign and an enrolled pair.")
    if given.list:
        lines += ["", *failures(results)]
    return [*lines, ""]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Which scenes are read, beside the options of every benchmark."""
    parser.add_argument("yardsticks", nargs="*", choices=[*YARDSTICKS, []], help="default: all")
    parser.add_argument("--rounds", type=int, default=1, help="rounds of scenes, each of other seeds")
    parser.add_argument("--most", type=int, help="only the first so many scenes of a yardstick")
    parser.add_argument("--dump", type=Path, help="folder into which the scenes are written")
    parser.add_argument("--bank", type=Path, help="folder of dumped scenes to be read")
    parser.add_argument("--list", action="store_true", help="each scene that was not right")


def names(given: argparse.Namespace) -> None:
    """Read, print, and write the page of the reader."""
    if given.quick and given.most is None:
        given.most = 3
    kept, before = Answers(given.keep), Answers(RULES)
    lines = page("The reader on every yardstick", SEEDS, __doc__)
    for yardstick in given.yardsticks or YARDSTICKS:
        lines += section(yardstick, given, kept, before)
    publish(lines, given.write, "reading.md")


if __name__ == "__main__":
    from tests.benchmarks.__main__ import main

    sys.argv[:1] = [str(Path(__file__).with_name("__main__.py")), "readers"]
    sys.exit(main())
