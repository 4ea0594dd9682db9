"""Any yardstick read with the rules, with the evidence, or with both, and one table that compares them.

    python tests/benchmarks/readers.py y1 y5 null --readers rules evidence

The yardsticks are those of `readers_scenes.py`. Both readers get the same scans, prepared as by `bodies.py`.
The answers of the rules are kept in answers_of_the_rules.jsonl and not read again, those of the evidence only
with --keep. --dump FOLDER writes each scene as a pickled dictionary, FOLDER/YARDSTICK/NNNN.pkl, in an order
of which every k-th is a fair sample; --bank FOLDER reads such files instead of drawing the scenes.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from readers_scenes import YARDSTICKS, drawn

from tagid.errors import TagidError

RULES = Path(__file__).with_name("answers_of_the_rules.jsonl")
Prepared = dict[str, Any]
"""A scene with its scans: what `Scene.prepared` returns."""


@dataclass(frozen=True)
class Answer:
    """What became of one scene: `outcome` is right, wrong, or what was answered instead of a name."""

    key: str
    group: str
    truth: str | None
    outcome: str
    name: str | None
    seconds: float


def rules(scene: Prepared) -> tuple[str, str | None]:
    """Status and name of `read_tag`, the code of a refusal for its status."""
    read_tag = importlib.import_module("tagid.tags.matching.matcher").read_tag
    reading = read_tag(scene["scans"], scene["layouts"], None, scene["enrolled"])
    return reading.code.value or reading.status, reading.layout


def evidence(scene: Prepared) -> tuple[str, str | None]:
    """Status and name of the reader of `tagid.reading`."""
    read = importlib.import_module("tagid.reading.reader").read
    answer = read(scene["scans"], scene["layouts"], signatures=scene["signatures"])
    return answer.status, answer.name


READERS: dict[str, Callable[[Prepared], tuple[str, str | None]]] = {"rules": rules, "evidence": evidence}


def answer(reader: str, scene: Prepared) -> Answer:
    """The answer of a reader to a scene."""
    start = time.process_time()
    try:
        outcome, name = READERS[reader](scene)
    except TagidError as error:
        outcome, name = f"failed: {error.code}", None
    seconds = round(time.process_time() - start, 2)
    if outcome == "identified":
        right = scene["truth"] is not None and name in (scene["truth"], scene["alias"])
        outcome = "right" if right else "wrong"
    return Answer(scene["key"], scene["group"], scene["truth"], outcome, name, seconds)


class Answers:
    """Answers of one reader; kept in a file if a path is given."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        lines = path.read_text().splitlines() if path and path.is_file() else []
        self.by_key = {found["key"]: Answer(**found) for found in map(json.loads, lines)}

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
        readers: which are to read it.
    """

    key: str
    make: Callable[[], Prepared | None]
    path: Path | None
    readers: tuple[str, ...]


def prepared(draw: Callable[[], Any]) -> Prepared | None:
    """A drawn scene with its scans."""
    scene = draw()
    return None if scene is None else scene.prepared()


def load(path: Path) -> Prepared:
    """A dumped scene."""
    return pickle.loads(path.read_bytes())


def done(task: Task) -> dict[str, Answer] | None:
    """The answers to a scene; None if there is no such scene."""
    scene = task.make()
    if scene is None:
        return None
    if task.path is not None:
        task.path.parent.mkdir(parents=True, exist_ok=True)
        part = task.path.with_suffix(".part")
        part.write_bytes(pickle.dumps(scene, protocol=5))
        part.rename(task.path)
    return {reader: answer(reader, scene) for reader in task.readers}


def tasks(yardstick: str, given: argparse.Namespace, kept: dict[str, Answers]) -> Iterator[Task]:
    """What is to be done for a yardstick; a scene that is dumped and answered has nothing to do."""
    if given.bank:
        paths = sorted((given.bank / yardstick).glob("*.pkl"))
        scenes = [(load(path)["key"], partial(load, path)) for path in paths]
    else:
        scenes = [(key, partial(prepared, draw)) for key, draw in drawn(yardstick, given.rounds)]
    for i, (key, make) in enumerate(scenes[: given.most]):
        path = given.dump / yardstick / f"{i:04d}.pkl" if given.dump else None
        readers = tuple(reader for reader in given.readers if key not in kept[reader].by_key)
        yield Task(key, make, None if path is None or path.exists() else path, readers)


def table(yardstick: str, answers: dict[str, list[Answer]]) -> list[str]:
    """Groups against readers: of tagged scenes right and wrong, of others how many were named."""
    head = "".join(f" {r}: right | wrong | others named |" for r in answers)
    lines = [f"| {yardstick} | tagged | others |{head}", "|---" * (3 + 3 * len(answers)) + "|"]
    every = next(iter(answers.values()), [])
    for group in (*sorted({a.group for a in every}), "all"):
        size = [a.truth is None for a in every if group in (a.group, "all")]
        cells = [group, str(size.count(False)), str(size.count(True))]
        for own in answers.values():
            some = [a for a in own if group in (a.group, "all")]
            cells += [str(sum(a.outcome == "right" for a in some))]
            for none in (False, True):
                cells += [str(sum(a.outcome == "wrong" and (a.truth is None) == none for a in some))]
        lines.append("| " + " | ".join(cells) + " |")
    for reader, own in answers.items():
        seconds = [a.seconds for a in own] or [0.0]
        lines.append(
            f"\n{reader}: CPU seconds of a reading: median {np.median(seconds):.2f}, "
            f"95 % under {np.quantile(seconds, 0.95):.2f}, most {max(seconds):.2f}."
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("yardsticks", nargs="*", choices=[*YARDSTICKS, []], help="default: all")
    parser.add_argument("--readers", nargs="*", choices=tuple(READERS), default=["rules"])
    parser.add_argument("--rounds", type=int, default=1, help="rounds of scenes, each of other seeds")
    parser.add_argument("--most", type=int, help="only the first so many scenes of a yardstick")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--dump", type=Path, help="folder into which the scenes are written")
    parser.add_argument("--bank", type=Path, help="folder of dumped scenes to be read")
    parser.add_argument("--keep", type=Path, help="file of answers of the evidence, which is continued")
    parser.add_argument("--list", action="store_true", help="each scene that was not right")
    given = parser.parse_args()
    kept = {"rules": Answers(RULES), "evidence": Answers(given.keep)}
    for yardstick in given.yardsticks or YARDSTICKS:
        todo = list(tasks(yardstick, given, kept))
        missing = 0
        with multiprocessing.get_context("fork").Pool(given.jobs) as pool:
            for found in pool.imap(done, [t for t in todo if t.path or t.readers]):
                missing += found is None
                for reader, own in (found or {}).items():
                    kept[reader].add(own)
        answers = {r: [kept[r].by_key[t.key] for t in todo if t.key in kept[r].by_key] for r in given.readers}
        print("\n".join(table(yardstick, answers)))
        if missing:
            print(f"\n{missing} scenes left out: not solved, or drawn as foreign and an enrolled pair.")
        if given.list:
            for reader, own in answers.items():
                for a in own:
                    if a.outcome != "right" and (a.truth or a.outcome == "wrong"):
                        print(f"    {reader} | {a.key} | {a.truth} | {a.outcome} {a.name or ''}")
        print(flush=True)


if __name__ == "__main__":
    main()
