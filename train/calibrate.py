"""Calibrate the decision about tags on bodies: scores of objects that carry no enrolled tag.

Run `python -m train.calibrate --first 200000 --count 4000 --jobs 2 --scores scores.jsonl`, as often and on as
many machines as wanted, then `python -m train.calibrate --write tagid/tags/bodies/calibration.json FILES` to
make the file that the package ships. Seeds from SEALED on are not for this.

With --only bare both commands calibrate names without a body alone, 3,000 objects in 12 minutes of one core;
the rest of the file stays as it is.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from tagid import processes
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.tags.bodies.calibration import Basis, Calibration, Scores, Stratum
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.matcher import null_evidence_of
from train.population import STATEMENT, Specimen, draw

SEALED = 9_000_000
"""Seeds from here on are drawn once, for the report."""
VIEWS = (12, 24, 361)
SNRS_DB = (-np.inf, np.inf)
LONGEST_GAP = 1000
"""Seeds farther apart belong to two runs."""
REFUSED = "refused"
KEPT = 60
"""Scores kept of each stratum: p-values up to 60 / n are exact."""


def one(seed: int, bodies: bool = True) -> dict[str, float | int | str]:
    """The scores of the object of a seed, on a round body and without one."""
    return _scored(seed, draw(seed), bodies)


def _foreign(seed: int, bodies: bool, views: tuple[int, ...]) -> dict[str, float | int | str] | None:
    """The same; None for what was drawn as a foreign object and is an enrolled pair."""
    specimen = draw(seed, views=views[seed % len(views)] if views else None)
    return None if specimen.is_enrolled_pair else _scored(seed, specimen, bodies)


def _scored(seed: int, specimen: Specimen, bodies: bool) -> dict[str, float | int | str]:
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    scans = preprocess(specimen.capture, settings=settings)
    found = null_evidence_of(scans, list(builtin_layouts().values()), bodies=bodies)
    leads = {Basis.BARE: found.bare}
    if bodies:
        leads |= {Basis.BODY: max(found.round, found.wall)}
    row: dict[str, float | int | str] = {"seed": seed, "views": specimen.views, "snr_db": found.snr_db}
    return row | {kind.value: lead if np.isfinite(lead) else REFUSED for kind, lead in leads.items()}


def strata(rows: list[dict[str, float | int | str]], views: list[int]) -> tuple[Stratum, ...]:
    """Scores by views and SNR, of every kind of evidence that the rows have."""
    found = []
    for low, high in pairwise(views):
        for weak, strong in pairwise(SNRS_DB):
            own = [r for r in rows if low <= float(r["views"]) < high and weak <= float(r["snr_db"]) < strong]
            scores = {}
            for kind in Basis:
                leads = [
                    None if r[kind.value] == REFUSED else float(r[kind.value]) for r in own if kind.value in r
                ]
                if leads:
                    scores[kind] = Scores.of(leads, KEPT)
            found.append(Stratum(low, high, float(weak), float(strong), scores))
    return tuple(found)


def ranges(seeds: list[int]) -> tuple[tuple[int, int], ...]:
    """[first, last) of every run of seeds, which --only-views thins."""
    starts = [0, *(i for i, (a, b) in enumerate(pairwise(seeds), 1) if b - a > LONGEST_GAP), len(seeds)]
    return tuple((seeds[a], seeds[b - 1] + 1) for a, b in pairwise(starts))


def replaced(known: Calibration, drawn: tuple[Stratum, ...], seeds: list[int], kind: Basis) -> Calibration:
    """A calibration with one kind of evidence of other strata, which may have limits of their own."""
    kept = [
        replace(old, scores={k: v for k, v in old.scores.items() if k is not kind}) for old in known.strata
    ]
    fresh = [replace(new, scores={kind: new.scores.get(kind, Scores())}) for new in drawn]
    merged = {one.name: one for one in kept if one.scores}
    for new in fresh:
        old = merged.get(new.name, new)
        merged[new.name] = replace(old, scores={**old.scores, **new.scores})
    return replace(known, strata=tuple(merged.values()), seeds={**known.seeds, kind: ranges(seeds)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="scores to make the calibration of")
    parser.add_argument("--write", type=Path, help="calibration file to write")
    parser.add_argument("--first", type=int, default=200_000)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--only-views", type=int, nargs="*", help="only objects with so many views")
    parser.add_argument(
        "--draw-views",
        type=int,
        nargs="*",
        default=(),
        help="views of the objects, in turn; else drawn",
    )
    parser.add_argument(
        "--views", type=int, nargs="*", default=VIEWS, help="limits of the strata; each needs 999 objects"
    )
    parser.add_argument("--only", type=Basis, choices=list(Basis), help="one kind of evidence")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--scores", type=Path, default=Path("scores.jsonl"))
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.count)
    if any(seed >= SEALED for seed in seeds):
        parser.error(f"seeds from {SEALED} on are sealed")
    if arguments.count:
        only = arguments.only_views
        chosen = [s for s in seeds if not only or draw(s).views in only]
        with (
            processes.spawn_context().Pool(arguments.jobs) as pool,
            arguments.scores.open("a") as file,
        ):
            for row in pool.imap_unordered(
                partial(_foreign, bodies=arguments.only is not Basis.BARE, views=tuple(arguments.draw_views)),
                chosen,
                chunksize=4,
            ):
                if row is not None:
                    file.write(json.dumps(row) + "\n")
                    file.flush()
    if arguments.write:
        rows = {}
        for path in arguments.files:
            for line in path.read_text().splitlines():
                row = json.loads(line)
                rows[row["seed"]] = row
        drawn = strata(list(rows.values()), arguments.views)
        if arguments.only:
            known = Calibration.from_json(arguments.write.read_text("utf-8"))
            made = replace(replaced(known, drawn, sorted(rows), arguments.only), population=STATEMENT)
        else:
            made = Calibration(STATEMENT, drawn, dict.fromkeys(Basis, ranges(sorted(rows))))
        arguments.write.write_text(made.to_json())


if __name__ == "__main__":
    main()
