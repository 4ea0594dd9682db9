"""The search for the axis distance and for the path delay over scenes that no point model made.

Run `python tests/benchmarks/bench_focus.py --write`; `--seeds N` sets the scenes per family and radar,
`--first` the first seed. The criterion was chosen on seeds from 1000 on; the reported ones start at 5000.
`--resume FILE` keeps every outcome in a file (JSON lines) and leaves out the scenes that it already holds.
`--paths` reads the paths alone and, with --write, replaces their section of the page.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from focus_rails import PATHS, draw_rail
from focus_scenes import FAMILIES, FULL_WAVE, FULL_WAVE_OBJECTS, RADARS, draw_scene, full_wave_scene
from imaging_report import heading, made_with

from tagid.geometry import ImageGrid
from tagid.imaging.region import choose_region
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings
from tagid.proportion import wilson

FIRST_SEED = 5000
RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results" / "focus.md"


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


def try_task(task: Task) -> Outcome:
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
    error, left = (given - scene.true_m) / lam, (guess - scene.true_m) / lam
    return Outcome(row, focus.reliable, error, left, focus.reason)


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


def table(found: list[Outcome]) -> str:
    """The scenes of every row: taken rightly, between, wrongly, and kept."""
    rows = list(dict.fromkeys(o.row for o in found))
    columns = ("scenes", "n", "taken", "< 1/8", "1/8 to 1/4", "> 1/4", "kept", "rms of taken (λ/1000)")
    lines = ["| " + " | ".join((*columns, "guess < 1/8")) + " |", "|" + "---|" * (len(columns) + 1)]
    for row in [*rows, ""]:
        some = [o for o in found if row in ("", o.row)]
        taken = [o for o in some if o.taken]
        good = sum(abs(o.guess) < 1 / 8 for o in taken)
        wrong = sum(not abs(o.guess) <= 1 / 4 for o in taken)
        rms = f"{1e3 * np.sqrt(np.mean([o.guess**2 for o in taken])):.0f}" if taken else "-"
        guessed = sum(abs(o.guess) < 1 / 8 for o in some)
        cells = [row or "**all**", len(some), len(taken), good, len(taken) - good - wrong, wrong]
        lines.append("| " + " | ".join(map(str, [*cells, len(some) - len(taken), rms, guessed])) + " |")
    return "\n".join(lines)


def summary(found: list[Outcome]) -> str:
    """The figures of all scenes in two sentences."""
    taken = [o for o in found if o.taken]
    good = sum(abs(o.guess) < 1 / 8 for o in taken)
    wrong = sum(not abs(o.guess) <= 1 / 4 for o in taken)
    worse = sum(abs(o.left) > 1 / 8 and abs(o.given) < 1 / 8 for o in found)
    share, off = good / max(len(taken), 1), 100 * wrong / len(found)
    sure = wilson(share, len(taken))
    return (
        f"Of {len(found)} scenes {len(taken)} estimates were taken: {good} ({100 * share:.1f} %, 95 % "
        f"interval {100 * sure.low:.0f} to {100 * sure.high:.0f} %)\nwithin an eighth of a wavelength, "
        f"{wrong} ({off:.2f} % of all scenes) off by over a quarter. In {worse}\n"
        "scenes a given value that was right within an eighth was replaced by one that is not."
    )


def without_late(found: list[Outcome]) -> str:
    """The figures without the octahedra whose echo is late as a whole."""
    taken = [o for o in found if o.taken and "40 mm octahedra" not in o.row]
    good = sum(abs(o.guess) < 1 / 8 for o in taken)
    return (
        f"Without the rows of 40 mm octahedra {good} of {len(taken)} estimates are within an eighth "
        f"({100 * good / max(len(taken), 1):.1f} %)."
    )


def tasks(seeds: int, first: int, rails: int) -> tuple[list[Task], list[Task]]:
    """Turntable scenes and paths."""
    numbers = range(first, first + seeds)
    turns = [Task("body", f, r, s) for f in FAMILIES for r in range(len(RADARS)) for s in numbers]
    if FULL_WAVE.is_file():
        few = range(first, first + -(-seeds // 2))
        turns += [Task("full wave", name, 0, s) for name in FULL_WAVE_OBJECTS for s in few]
    return turns, [Task("rail", path, 0, s) for path in PATHS for s in range(first, first + rails)]


def reasons(found: list[Outcome]) -> str:
    """How often each reason was given."""
    counted: Counter[str] = Counter()
    for reason in (o.reason for o in found if o.reason):
        reason = "its standard error is too large" if "standard error" in reason else reason
        counted["the image does not stand above the noise" if "dB over" in reason else reason] += 1
    return "\n".join(f"- {count} x {reason}" for reason, count in counted.most_common())


def outcomes(items: list[Task], jobs: int, kept: Path | None) -> list[Outcome]:
    """The outcome of every item, in their order, over processes; those in the file `kept` are not redone."""
    done: dict[Task, Outcome] = {}
    if kept is not None and kept.exists():
        for line in kept.read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            done[Task(*entry["task"])] = Outcome(*entry["outcome"])
    rest = [item for item in items if item not in done]
    with ExitStack() as stack:
        file = stack.enter_context(kept.open("a", encoding="utf-8")) if kept else None
        pool = stack.enter_context(ProcessPoolExecutor(jobs)) if jobs > 1 else None
        found = pool.map(try_task, rest, chunksize=4) if pool else map(try_task, rest)
        for task, outcome in zip(rest, found, strict=True):
            done[task] = outcome
            if file is not None:
                print(json.dumps({"task": task, "outcome": outcome}), file=file, flush=True)
    return [done[item] for item in items]


TEXT = """{head}
The criterion was chosen on other seeds, from 1000 on. Scenes are drawn by
`tests/benchmarks/focus_scenes.py` and `focus_rails.py`: the distance given is right in a third of the scenes
and wrong by up to 0.4 wavelengths in the others; noise 10 to 30 dB under the strongest sample, 36 to 360
views, a turn that is uneven by up to 0.6 degrees, antenna sometimes above the object's plane. The path delay
is wrong by up to 0.9 m. Errors are in wavelengths (75.9 mm for the P440, 17.2 mm for the others).

"Kept" means that the given value stayed and the output said why. A best guess is printed in every case.

## Axis distance

{turns}

A convex body's echo comes from its nearest wall in every view. Another distance makes it look larger or
smaller, not worse, and the best guess for such a scene is worth nothing: the given value is kept. Octahedra
of 40 mm resonate in the band of the P440; their echo is late by about a tenth of a wavelength, and the
distance found is too long by as much. A delay common to all echoes moves them as the distance does; only the
curvature of the wave tells them apart, by less than a tenth of a millimetre at 1 m, which no scan resolves.
{but_late}

The scans tell such an echo where its delay changes within the band: the distances of the lower and the upper
half then differ by more than their noise. Of 480 full-wave scenes of seeds 1000 to 1039 (octahedra alone and
on the shell) 385 estimates were taken before the halves were compared, 29 of them off by over an eighth, all
with octahedra of 40 mm. Comparing the halves refuses 13 of these 29, 12 of them on the shell, and 16 of the
356 right ones (7 on the shell): 95.5 % of those taken are right instead of 92.5 %, on the seeds on which the
comparison was chosen. With octahedra alone it tells little: the halves differ by 0.02 wavelengths (median)
where the distance is off by over an eighth and by 0.03 where it is not, at a standard error of 0.03. Two
other signs were tried on these seeds and do not tell them, either:

- The delay of a 40 mm octahedron changes with its aspect in horizontal polarisation, where 13 of 67 estimates
  are off by over an eighth. But echoes between reflectors change it as well: beyond the noise it varies over
  the sectors by 0.030 wavelengths (median), by 0.027 in vertical polarisation, where 2 of 116 are off by over
  an eighth, and by 0.017 to 0.020 for 20 mm.
- The echo is weaker at both edges of the band. That tells a resonance only if the pulse is known: the
  logarithm of the amplitude is curved by -0.35 to -0.58 per GHz² for 40 mm, and by -0.8 to -2.3 for seven
  recorded pulses of a P440 against the nominal one.

## Path delay

{paths}

## Why values were kept

{why}
"""

PATHS_TEXT = """## Path delay

`{command}`, {made}.

{paths}

With places of echoes no finer than 4 mm at the end of the search (commit ee95e0d739, the same 120 scenes) 68
were taken, 65 of them within an eighth and none off by over a quarter.

Kept:

{why}

"""


def only_paths(given: argparse.Namespace) -> str:
    """The section of the paths, with what made it."""
    delays = outcomes(tasks(0, given.first, given.rails)[1], given.jobs, given.resume)
    return PATHS_TEXT.format(
        command=f"python tests/benchmarks/bench_focus.py --paths --rails {given.rails} --write",
        made=made_with(),
        paths=f"{summary(delays)}\n\n{table(delays)}",
        why=reasons(delays),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=13)
    parser.add_argument("--rails", type=int, default=10)
    parser.add_argument("--first", type=int, default=FIRST_SEED)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--resume", type=Path, metavar="FILE")
    parser.add_argument("--paths", action="store_true", help="the section of the paths alone")
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    if given.paths:
        section = only_paths(given)
        print(section)
        if given.write:
            page = RESULTS.read_text(encoding="utf-8")
            whole = re.compile(r"## Path delay\n.*?(?=## |\Z)", re.DOTALL)
            RESULTS.write_text(whole.sub(lambda _: section, page), encoding="utf-8")
        return
    turns, paths = tasks(given.seeds, given.first, given.rails)
    found = outcomes(turns, given.jobs, given.resume)
    delays = outcomes(paths, given.jobs, given.resume)
    text = TEXT.format(
        head=heading(
            "Focus: axis distance and path delay",
            f"python tests/benchmarks/bench_focus.py --seeds {given.seeds} --rails {given.rails} --write",
            f"{given.seeds} scenes per row from {given.first} on (full wave: half as many per object)",
        ),
        turns=f"{summary(found)}\n\n{table(found)}",
        but_late=without_late(found),
        paths=f"{summary(delays)}\n\n{table(delays)}",
        why=reasons(found + delays),
    )
    print(text)
    if given.write:
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
