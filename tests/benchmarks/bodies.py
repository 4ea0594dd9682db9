"""Tags on bodies, blind: full-wave scenes, null and foreign objects, and whether more signal or views helps.

Run `python tests/benchmarks/bodies.py --write docs/results` for the tables, `--only fullwave --scenes 1` for
a check of some minutes. Full-wave responses are read from ../shared/fullwave beside the checkout. Sealed
seeds (tests/data/sealed_population.json) are read where the generator's hash agrees; nothing is chosen on
them.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType

os.environ.setdefault("OMP_NUM_THREADS", "1")
# train/ is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from identification import wilson

from tagid.capture import Capture
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.matcher import read_tag
from train.population import STATEMENT, draw

ROOT = Path(__file__).resolve().parents[2]
FULLWAVE = ROOT.parent / "shared" / "fullwave"
SEALED = ROOT / "tests" / "data" / "sealed_population.json"
LAYOUTS = list(builtin_layouts().values())
PARTS = ("fullwave", "foreign", "monotone")


@dataclass(frozen=True)
class Scene:
    """One full-wave scene: an object of the responses, or a body with reflectors at any angles."""

    group: str
    name: str
    angles_deg: tuple[float, ...] | None
    truth: str | None


@dataclass(frozen=True)
class Recording:
    """How it is recorded."""

    views: int = 36
    snr_db: float = 20.0
    offset_m: float = 0.006
    polarisation: str = "V"
    hard: bool = False

    @property
    def label(self) -> str:
        words = [f"{self.views} views", f"{self.snr_db:.0f} dB", f"{self.offset_m * 1e3:.0f} mm off"]
        words += ["horizontal"] if self.polarisation == "H" else []
        words += ["measured pulse, wobble 1 %, axis wrong by up to 10 mm"] if self.hard else []
        return ", ".join(words)


RECORDINGS = (
    Recording(),
    Recording(snr_db=10.0),
    Recording(offset_m=0.0),
    Recording(offset_m=0.010),
    Recording(snr_db=10.0, offset_m=0.010, hard=True),
    Recording(polarisation="H"),
    Recording(views=18),
    Recording(views=72),
)
NAMES = {"c90": "container-90", "c180": "container-180", "h120": "helmet-120", "lin": "helmet-linear"}
FOREIGN = (
    (), (0,), (0, 40), (0, 60), (0, 70), (0, 110), (0, 125), (0, 135), (0, 150), (0, 160), (0, 120, 240),
    (0, 90, 180), (0, 90, 200), (0, 60, 180), (0, 90, 180, 270), (0, 45, 180, 225), (0, 72, 144, 216, 288),
)  # fmt: skip


def scenes() -> list[Scene]:
    """Bare tags, round bodies, shells; untagged and foreign ones."""
    found = [
        Scene("bare tag", f"free{size}_{kind}", None, name)
        for size in (20, 40)
        for kind, name in NAMES.items()
    ]
    for can in ("can35", "can28"):
        found += [Scene("metal can", can, (0.0, 90.0), "container-90")]
        found += [Scene("metal can", can, (0.0, 180.0), "container-180")]
        found += [Scene("foreign or untagged", can, tuple(map(float, a)), None) for a in FOREIGN]
    found += [Scene("helmet shell", f"shell_h120_{size}", None, "helmet-120") for size in (20, 40)]
    others = ("shell", "can35_handle", "free20_one", "free40_one")
    found += [Scene("foreign or untagged", name, None, None) for name in others]
    return found


def generator() -> ModuleType:
    """The module that makes captures of responses."""
    spec = importlib.util.spec_from_file_location("scenes", FULLWAVE / "scenes.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def captured(scene: Scene, recording: Recording, seed: int) -> Capture:
    """A capture; reflectors at other angles are turned copies of one, added to the body's response."""
    made = generator_once()
    name = scene.name
    base = name.split("_")[0]
    if scene.angles_deg is not None:
        name = f"{base}@" + ",".join(f"{a:g}" for a in scene.angles_deg)
        frequency, body = made.response(base)
        own = made.response(f"{base}_one")[1] - body
        order = np.fft.fftfreq(body.shape[2], 1 / body.shape[2])
        turned = sum(own * np.exp(-1j * order * np.deg2rad(a)) for a in scene.angles_deg)
        made._cache[name] = (frequency, body + turned)
    one = f"{base}_one-{base}"
    if base.startswith("free"):
        one = f"{base}_one"
    elif base == "shell":
        one = "free40_one" if name.endswith("40") else "free20_one"
    rng = np.random.default_rng([seed, 17, sum(map(ord, name))])
    turn = rng.uniform(0, 2 * np.pi)
    hard = {"pulse": "cr08", "wobble": 0.01, "distance_error": rng.uniform(-0.01, 0.01)}
    scan, _ = made.make(
        name,
        rng,
        reference=one,
        views=recording.views,
        distance=rng.uniform(0.8, 1.2),
        centre=(recording.offset_m * np.cos(turn), recording.offset_m * np.sin(turn)),
        snr_db=recording.snr_db,
        pol=recording.polarisation,
        **(hard if recording.hard else {}),
    )
    return Capture(
        scan["samples"],
        scan["range_start_m"],
        scan["range_step_m"],
        scan["angles_rad"],
        axis_distance_m=scan["axis_distance_m"],
    )


_MADE: list[ModuleType] = []


def generator_once() -> ModuleType:
    if not _MADE:
        _MADE.append(generator())
    return _MADE[0]


@dataclass(frozen=True)
class Answer:
    """What became of one scene."""

    group: str
    column: str
    outcome: str
    seconds: float


def answer(capture: Capture, truth: str | None) -> tuple[str, float]:
    start = time.process_time()
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    reading = read_tag(preprocess(capture, settings=settings), LAYOUTS)
    seconds = time.process_time() - start
    if reading.status != "identified":
        return reading.code.value, seconds
    return ("correct" if reading.layout == truth else "wrong"), seconds


def one_fullwave(task: tuple[Scene, Recording, int]) -> Answer:
    scene, recording, seed = task
    outcome, seconds = answer(captured(scene, recording, seed), scene.truth)
    return Answer(scene.group, recording.label, outcome, seconds)


def one_foreign(seed: int) -> Answer:
    specimen = draw(seed)
    outcome, seconds = answer(specimen.capture, None)
    return Answer(specimen.body, f"{specimen.views} views", outcome, seconds)


def one_tagged(task: tuple[int, int, float]) -> Answer:
    seed, views, snr = task
    specimen = draw(seed, tagged=True, views=views, snr_db=snr)
    outcome, seconds = answer(specimen.capture, specimen.truth)
    return Answer(f"{views} views", f"{snr:.0f} dB", outcome, seconds)


def cell(hits: int, total: int) -> str:
    low, high = wilson(hits, total)
    return f"{hits}/{total} ({100 * low:.0f}..{100 * high:.0f} %)"


def table(answers: list[Answer], wanted: str) -> list[str]:
    """Groups against conditions: how many had the outcome wanted; "refused" is any that names nothing."""
    columns = list(dict.fromkeys(a.column for a in answers))
    lines = ["| | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for group in dict.fromkeys(a.group for a in answers):
        cells = []
        for column in columns:
            own = [a.outcome for a in answers if a.group == group and a.column == column]
            hits = sum(o == wanted or (wanted == "refused" and o not in ("correct", "wrong")) for o in own)
            cells.append(cell(hits, len(own)) if own else "")
        lines.append(f"| {group} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def fullwave(jobs: int, number: int) -> list[str]:
    """Named and refused full-wave scenes; odd seeds, which nothing was chosen on."""
    if not FULLWAVE.exists():
        return ["Full-wave responses are not beside this checkout: not run.", ""]
    tasks = [(s, r, 2 * i + 1) for s in scenes() for r in RECORDINGS for i in range(number)]
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        answers = pool.map(one_fullwave, tasks, chunksize=4)
    named = [a for a in answers if a.group != "foreign or untagged"]
    others = [a for a in answers if a.group == "foreign or untagged"]
    wrong = sum(a.outcome == "wrong" for a in named)
    lines = ["Named rightly, blind (95 % interval):", "", *table(named, "correct")]
    lines += [f"Named wrongly: {cell(wrong, len(named))}. Refusals: {reasons(named)}.", ""]
    lines += ["Refused, as they should be:", "", *table(others, "refused")]
    return [*lines, f"CPU seconds, median: {np.median([a.seconds for a in answers]):.2f}.", ""]


def reasons(answers: list[Answer]) -> str:
    count = Counter(a.outcome for a in answers if a.outcome not in ("correct", "wrong"))
    return ", ".join(f"{code} {n}" for code, n in count.most_common()) or "none"


def sealed_seeds() -> range:
    """The sealed seeds. Ends the program where the generator is not the one that they were sealed with."""
    sealed = json.loads(SEALED.read_text())
    digest = hashlib.sha256((ROOT / "train" / "population.py").read_bytes()).hexdigest()
    if digest != sealed["generator_sha256"]:
        raise SystemExit("train/population.py changed after the seeds were sealed: seal new ones")
    return range(sealed["first"], sealed["first"] + sealed["count"])


def foreign(jobs: int, number: int) -> list[str]:
    """Named objects of the sealed population."""
    seeds = sealed_seeds()
    seeds = seeds[: min(number, len(seeds))]
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        answers = pool.map(one_foreign, seeds, chunksize=8)
    named = sum(a.outcome == "wrong" for a in answers)
    _, most = wilson(named, len(answers))
    head = f"Population: {STATEMENT}. Seeds {seeds[0]} to {seeds[-1]}."
    return [
        head,
        "",
        f"Named: {named} of {len(answers)}, 95 % upper bound {100 * most:.2f} %.",
        "",
        *table(answers, "refused"),
    ]


def monotone(jobs: int, number: int) -> list[str]:
    """Tagged objects of the population at every SNR and number of views: the same seeds in each cell."""
    tasks = [(s, v, n) for v in (12, 18, 36, 72) for n in (0.0, 5.0, 10.0, 20.0, 30.0) for s in range(number)]
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        answers = pool.map(one_tagged, tasks, chunksize=8)
    return ["Bare tags and cans of the simulated population, named rightly:", "", *table(answers, "correct")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--scenes", type=int, default=4, help="recordings of each full-wave scene")
    parser.add_argument("--objects", type=int, default=10_000, help="sealed objects")
    parser.add_argument("--grid", type=int, default=60, help="tagged objects in each cell of the grid")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--write", type=Path, help="folder for bodies.md")
    arguments = parser.parse_args()
    parts = {
        "fullwave": ("Full-wave scenes", lambda: fullwave(arguments.jobs, arguments.scenes)),
        "foreign": ("Null and foreign objects", lambda: foreign(arguments.jobs, arguments.objects)),
        "monotone": ("More signal, more views", lambda: monotone(arguments.jobs, arguments.grid)),
    }
    lines = ["# Tags on bodies, read blind", ""]
    lines += [f"`python {' '.join(sys.argv)}`, {datetime.now(UTC):%Y-%m-%d}, numpy {np.__version__}.", ""]
    for name in arguments.only:
        title, run = parts[name]
        lines += [f"## {title}", "", *run()]
    text = "\n".join(lines).rstrip() + "\n"
    print(text)
    if arguments.write:
        arguments.write.mkdir(parents=True, exist_ok=True)
        (arguments.write / "bodies.md").write_text(text)


if __name__ == "__main__":
    main()
