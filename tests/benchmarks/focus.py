"""The search for the axis distance and for the path delay over scenes that no point model made.

The criterion was chosen on seeds from 1000 on; the reported ones start at 5000.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tagid.geometry import ImageGrid
from tagid.imaging.region import choose_region
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings
from tagid.proportion import wilson
from tests.benchmarks.focus_rails import PATHS, draw_rail
from tests.benchmarks.focus_scenes import (
    FAMILIES,
    FULL_WAVE,
    FULL_WAVE_OBJECTS,
    RADARS,
    draw_scene,
    full_wave_scene,
)
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

FIRST_SEED = 5000
COLUMNS = (
    "scenes", "n", "taken", "< 1/8", "1/8 to 1/4", "> 1/4", "kept", "rms of taken (λ/1000)", "guess < 1/8"
)  # fmt: skip
NOTE = """The criterion was chosen on other seeds, from 1000 on. Scenes are drawn by `focus_scenes.py`: the
distance given is right in a third of the scenes and wrong by up to 0.4 wavelengths in the others; noise 10 to
30 dB under the strongest sample, 36 to 360 views, a turn that is uneven by up to 0.6 degrees, antenna
sometimes above the object's plane. Errors are in wavelengths (75.9 mm for the P440, 17.2 mm for the others).
"Kept" means that the given value stayed and the output said why. A best guess is printed in every case."""
PATHS_NOTE = """Paths are drawn by `focus_rails.py`; the path delay is wrong by up to 0.9 m."""


class Task(NamedTuple):
    """One scene: a family with the number of its radar, a full-wave object, or a path."""

    kind: str
    name: str
    radar: int
    seed: int


class Outcome(NamedTuple):
    """What came of a scene, in wavelengths.

    Attributes:
        row: row of the table.
        taken: whether an estimate was taken.
        given, guess: error of the value given and of the best guess.
        reason: why it was not taken.
    """

    row: str
    taken: bool
    given: float
    guess: float
    reason: str

    @property
    def left(self) -> float:
        """Error of what was used."""
        return self.guess if self.taken else self.given


def try_task(task: Task) -> dict[str, str | bool | float]:
    """The members of the `Outcome` of a scene."""
    return _tried(task)._asdict()


def _tried(task: Task) -> Outcome:
    """Draw a scene and search as every method does."""
    if task.kind == "rail":
        return _try_rail(task)
    if task.kind == "full wave":
        scene = full_wave_scene(task.name, task.seed)
        row = f"full wave: {_group(task.name)}"
    else:
        scene = draw_scene(task.name, RADARS[task.radar], task.seed)
        row = f"{task.name}, {scene.radar}"
    focus = PreparedCapture(scene.capture, ImagingSettings(extent_m=scene.extent_m)).focus()
    assert focus is not None
    lam, given, guess = scene.wavelength_m, scene.capture.axis_distance_m, focus.best_m
    assert given is not None and guess is not None
    error, remaining = (given - scene.true_m) / lam, (guess - scene.true_m) / lam
    return Outcome(row, focus.reliable, error, remaining, focus.reason)


def _try_rail(task: Task) -> Outcome:
    capture, delay = draw_rail(task.name, task.seed)
    focus = choose_region(capture, ImageGrid(0.5, 128), None, free_extent=True, free_pixels=True).focus
    assert focus is not None
    lam = capture.wavelength_m
    guess = float("nan") if focus.best_m is None else (focus.best_m - delay) / lam
    return Outcome(f"path: {task.name}", focus.reliable, -delay / lam, guess, focus.reason)


def _group(name: str) -> str:
    if name.startswith("free"):
        size = name.partition("_")[0][4:]
        return f"{size} mm octahedra, " + ("one" if name.endswith("one") else "several")
    return "helmet shell" if name.startswith("shell") else "metal cans, bare and tagged"


def rows_of(outcomes: list[Outcome]) -> list[list[object]]:
    """The scenes of every row: taken rightly, between, wrongly, and kept."""
    rows = list(dict.fromkeys(o.row for o in outcomes))
    lines = []
    for row in [*rows, ""]:
        some = [o for o in outcomes if row in ("", o.row)]
        taken = [o for o in some if o.taken]
        good = sum(abs(o.guess) < 1 / 8 for o in taken)
        wrong = sum(not abs(o.guess) <= 1 / 4 for o in taken)
        rms = f"{1e3 * np.sqrt(np.mean([o.guess**2 for o in taken])):.0f}" if taken else "-"
        guessed = sum(abs(o.guess) < 1 / 8 for o in some)
        cells = [row or "**all**", len(some), len(taken), good, len(taken) - good - wrong, wrong]
        lines.append([*cells, len(some) - len(taken), rms, guessed])
    return lines


def summary(outcomes: list[Outcome]) -> str:
    """The figures of all scenes in two sentences."""
    taken = [o for o in outcomes if o.taken]
    good = sum(abs(o.guess) < 1 / 8 for o in taken)
    wrong = sum(not abs(o.guess) <= 1 / 4 for o in taken)
    worse = sum(abs(o.left) > 1 / 8 and abs(o.given) < 1 / 8 for o in outcomes)
    share, off = good / max(len(taken), 1), 100 * wrong / len(outcomes)
    sure = wilson(share, max(len(taken), 1))
    return (
        f"Of {len(outcomes)} scenes {len(taken)} estimates were taken: {good} ({100 * share:.1f} %, 95 % "
        f"interval {100 * sure.low:.0f} to {100 * sure.high:.0f} %) within an eighth of a wavelength, "
        f"{wrong} ({off:.2f} % of all scenes) off by over a quarter. In {worse} "
        "scenes a given value that was right within an eighth was replaced by one that is not."
    )


def without_late(outcomes: list[Outcome]) -> str:
    """The figures without the octahedra whose echo is late as a whole."""
    taken = [o for o in outcomes if o.taken and "40 mm octahedra" not in o.row]
    good = sum(abs(o.guess) < 1 / 8 for o in taken)
    return (
        f"Without the rows of 40 mm octahedra {good} of {len(taken)} estimates are within an eighth "
        f"({100 * good / max(len(taken), 1):.1f} %)."
    )


def turns(seeds: int, first: int) -> list[Task]:
    """Turntable scenes; of full-wave objects half as many."""
    numbers = range(first, first + seeds)
    tasks = [Task("body", f, r, s) for f in FAMILIES for r in range(len(RADARS)) for s in numbers]
    if FULL_WAVE.is_file():
        few = range(first, first + -(-seeds // 2))
        tasks += [Task("full wave", name, 0, s) for name in FULL_WAVE_OBJECTS for s in few]
    return tasks


def reasons(outcomes: list[Outcome]) -> str:
    """How often each reason was given."""
    counted: Counter[str] = Counter()
    for reason in (o.reason for o in outcomes if o.reason):
        reason = "its standard error is too large" if "standard error" in reason else reason
        counted["the image does not stand above the noise" if "dB over" in reason else reason] += 1
    return "Kept:\n\n" + "\n".join(f"- {count} x {reason}" for reason, count in counted.most_common())


def add_options(parser: argparse.ArgumentParser) -> None:
    """The scenes."""
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="seed of the first scene")


def _table(run: Run, tasks: list[Task], note: str) -> tuple[list[Outcome], Table]:
    results = [Outcome(**members) for members in run.each(try_task, tasks).values()]
    text = f"{note}\n\n{summary(results)}"
    return results, Table(
        COLUMNS, rows_of(results), text, below=reasons(results), shown=lambda row: row[2] > 0
    )


def axis_distance(run: Run) -> Iterator[Table]:
    """Turntable scenes of every family and radar."""
    seeds = run.number(12)
    run.seeds = f"{seeds} scenes per row from {run.options.first} on (full wave: half as many per object)"
    result, table = _table(run, turns(seeds, run.options.first), NOTE)
    yield table
    yield Table((), (), without_late(result))


def path_delay(run: Run) -> Iterator[Table]:
    """Paths past reflectors."""
    seeds = run.number(30, 2)
    run.seeds = f"{seeds} per row from {run.options.first} on"
    numbers = range(run.options.first, run.options.first + seeds)
    yield _table(run, [Task("rail", path, 0, s) for path in PATHS for s in numbers], PATHS_NOTE)[1]
