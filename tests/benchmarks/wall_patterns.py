"""What free patterns and the waves of a wall leave of full-wave tags, and of other arrangements.

    PYTHONPATH=. python tests/benchmarks/wall_patterns.py --objects build/unseen --write docs/results

Solved round bodies (`unseen_objects.py`) are recorded at 40 dB, 36 views, 4 mm off the axis, with no wobble
and the right axis distance, in both polarisations: what is left is then the model's own error. *Other* is
the best arrangement of 1 to 4 reflectors that is not the layout.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from provenance import ROOT, commit
from unseen_scenes import Circumstances, Recording, recorded, truth_of

from tagid.fields.shells import Shell
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.simulate import Acquisition, Placement
from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.cylinder_reader import read_on_cylinder
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import builtin_layouts

NAMES = (
    *("closed25_c90", "closed25_c180", "tin28_c180", "closed32_c180"),
    *("plastic40_c180", "cup33_c90", "glass35_c90", "glass35_c180"),
)
"""Round bodies that were looked at: metal, then plastic, ceramic and glass."""
RECORDING = Recording(36, 40.0)
SEED = 11


@dataclass(frozen=True)
class Left:
    """Shares of the tag's echo that the right layout and the best other arrangement leave, and the lead."""

    layout: float
    other: float
    lead: float

    @classmethod
    def of(cls, reading: BodyReading | None, name: str) -> Left | None:
        """From a reading; None where another layout is the best."""
        if reading is None or reading.layouts[0].layout != name:
            return None
        other = min((one.left for one in reading.others), default=reading.body_left)
        return cls(reading.unexplained, max(other - reading.noise, 0.0) / reading.tag, reading.lead)

    @property
    def cells(self) -> str:
        """Of a table."""
        return f"{self.layout:.1%} | {self.other:.1%} | {self.lead:.2f}"


def wall_words(wall: Shell | None) -> str:
    """A wall in words."""
    if wall is None:
        return ""
    size = f"{wall.radius_m * 1e3:.0f} mm"
    if wall.metal:
        return f"metal {size}" + (", coated" if wall.wall_m else "")
    return f"{size}, {wall.wall_m * 1e3:g} mm of permittivity {wall.permittivity:g}"


def row(folder: Path, name: str, polarisation: str) -> str:
    """One line of the table."""
    placed = Placement((0.003, -0.0026), 0.9)
    where = Circumstances(Acquisition(placement=placed), polarisation, SEED)
    capture = recorded(folder, name, RECORDING, where)
    scans = preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
    spectra, settings = Spectra.of(scans), BodySettings()
    layouts = list(builtin_layouts().values())
    free = read_on_body(spectra, layouts, RoundBody(), settings)
    assert free is not None
    beside = read_on_cylinder(spectra, layouts, free, settings)
    cells = [
        found.cells if found is not None else "not found | | "
        for found in (Left.of(free, truth_of(name)), Left.of(beside, truth_of(name)))
    ]
    return (
        f"| {name} | {polarisation} | {' | '.join(cells)} | {wall_words(beside.wall if beside else None)} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=Path, default=ROOT / "build" / "unseen", help="solved objects")
    parser.add_argument("--write", type=Path, help="folder for wall-patterns.md")
    given = parser.parse_args()
    command = " ".join(["python", *sys.argv]).replace(str(given.objects), "build/unseen")
    lines = [
        "# Patterns beside walls",
        "",
        f"Command: `{command}`. Commit: {commit()}.",
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, one thread, Python "
        f"{platform.python_version()}, numpy {np.__version__}. Date: {datetime.now(UTC):%Y-%m-%d}.",
        f"Seeds: {SEED}, of the noise.",
        "",
        *str(__doc__).split("\n\n")[2].strip().splitlines(),
        "",
        "Free patterns have 2 to 5 complex amplitudes at each frequency for all reflectors of a tag, a wall",
        "has two, of electric and magnetic dipoles (`tagid/tags/bodies/cylinder_patterns.py`). The lead",
        "is what the other arrangement leaves more, over what the layout leaves, the model's error and the",
        "noise (docs/tags.md).",
        "",
        "| object | | free: layout | free: other | lead | wall: layout | wall: other | lead | wall found |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in NAMES:
        lines += [row(given.objects, name, polarisation) for polarisation in ("V", "H")]
        print(lines[-2], lines[-1], sep="\n", flush=True)
    text = "\n".join(lines) + "\n"
    if given.write:
        (given.write / "wall-patterns.md").write_text(text)


if __name__ == "__main__":
    main()
