"""One run of a benchmark: how much is computed, what is kept of it, and where it may write."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.benchmarks.provenance import commit

SHOWN_S = 10.0
"""Time between two lines of progress, s."""


@dataclass
class Run:
    """What the command line asks for.

    Attributes:
        quick: whether a look is enough: fewer scenes, shorter times.
        options: of this benchmark alone.
        jobs: processes.
        keep: file that keeps the result of every scene, so that a run can be stopped and continued.
        folder: for files of this run, removed afterwards; `TAGID_DATA` and `TAGID_CONFIG` lie in it.
        pictures: folder of figures; None where none are drawn.
        scenes: of `--seeds`; None for as many as the benchmark has by itself.
        seeds: what the page says of them; the benchmark sets it.
        commits: that kept results were made at, where they are not all of this run.
        failed: whether what the benchmark tries did not hold; it sets that, too.
        name: of the benchmark.
    """

    quick: bool
    options: argparse.Namespace
    jobs: int
    keep: Path | None
    folder: Path
    pictures: Path | None
    scenes: int | None = None
    seeds: str = "none"
    commits: set[str] = field(default_factory=set)
    failed: bool = False
    name: str = ""

    def number(self, usual: int, quick: int = 1) -> int:
        """How many scenes: those asked for, or the usual number, or the one for a look."""
        if self.scenes is not None:
            return self.scenes
        return quick if self.quick else usual

    def drawn(self, usual: int, quick: int = 1, first: int = 0) -> range:
        """Seeds of the scenes, from the first on, which the page names."""
        count = self.number(usual, quick)
        self.seeds = f"{first} to {first + count - 1}"
        return range(first, first + count)

    def say(self, text: str) -> None:
        """A line of progress."""
        print(text, file=sys.stderr, flush=True)

    def each(self, work: Callable[[Any], Any], jobs: Sequence[Any]) -> dict[Any, Any]:
        """work(job) of every job, in order; with `keep` those in the file are not done again.

        A job is a tuple of JSON values; results that are dictionaries of JSON values are kept. Members of
        later lines of one job replace those of earlier ones.
        """
        done: dict[Any, Any] = self._kept(work.__name__, jobs)
        here = commit() if self.keep else ""
        rest = [job for job in jobs if job not in done]
        began = shown = time.monotonic()
        with ExitStack() as stack:
            file, mapped = None, map
            if self.jobs > 1:
                mapped = stack.enter_context(multiprocessing.get_context("spawn").Pool(self.jobs)).imap
            if self.keep is not None:
                self.keep.parent.mkdir(parents=True, exist_ok=True)
                file = stack.enter_context(self.keep.open("a+"))
                if file.tell() and not self.keep.read_text().endswith("\n"):
                    print(file=file)  # after the last line of a run that was stopped
            for number, (job, result) in enumerate(zip(rest, mapped(work, rest), strict=True)):
                done[job] = result
                if file is not None and isinstance(result, dict):
                    self.commits.add(here)
                    entry = {"work": work.__name__, "commit": here, "job": job, "found": result}
                    print(json.dumps(entry), file=file, flush=True)
                now = time.monotonic()
                if now - shown > SHOWN_S:
                    remaining = (now - began) / (number + 1) * (len(rest) - number - 1) / 60
                    self.say(f"{work.__name__}: {number + 1} of {len(rest)}, {remaining:.1f} minutes more")
                    shown = now
        return {job: done[job] for job in jobs}

    def _kept(self, name: str, jobs: Sequence[Any]) -> dict[Any, Any]:
        """Results of the file, of these jobs."""
        done: dict[Any, Any] = {}
        if self.keep is None or not self.keep.exists():
            return done
        by_key = {json.dumps(job): job for job in jobs}
        for line in self.keep.read_text().splitlines():
            try:
                entry = json.loads(line)
            except ValueError:  # the last line of a run that was stopped
                continue
            job = by_key.get(json.dumps(entry["job"]))
            if entry["work"] == name and job is not None:
                done[job] = {**done.get(job, {}), **entry["found"]}
                self.commits.add(entry["commit"])
        return done
