"""Who finds reflectors among ghosts: local maxima, CLEAN in the scans, the network; and the network's time.

Run `python tests/benchmarks/bench_detector.py --scenes 300 --write`; it prints docs/results/detector.md, and
writes it on request. The scenes are the detector's test split (never trained or calibrated on).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# train/ is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from imaging_report import RESULTS, heading

from tagid.imaging.backprojection import backproject
from tagid.tags.reading.reflectors import find_reflectors
from train.dataset import SEED_BASES
from train.detector import Detection, Detector
from train.evaluate import Figures, Outcome, local_maxima, score, threshold_at
from train.images import focused_scans
from train.planes import GRID, NetworkInput
from train.scenes import draw_scene


def cleaned(capture: object) -> list[Detection]:
    """CLEAN's points as detections, surer the higher they stand out of the noise."""
    found = find_reflectors(focused_scans(capture, "ats"))  # type: ignore[arg-type]
    return [
        Detection(r.x_m, r.y_m, 2e-3, float(1 / (1 + np.exp(-(r.snr_db - 20) / 4))), 0.0, r.amplitude)
        for r in found
    ]


def row(name: str, outcomes: list[Outcome], threshold: float) -> str:
    f = Figures.of(outcomes, threshold)
    return (
        f"| {name} | {100 * f.recall:.1f} % | {100 * f.precision:.1f} % | "
        f"{100 * f.false_images:.1f} % | {f.rms_mm:.1f} mm |"
    )


SHIPPED = (0.1, 0.03, 0.01)
"""Shares of empty images with a false reflector for which the network states a threshold of its own."""

TEXT = """{head}
Scenes of the detector's test split: half of them have handles, rims, off-axis shells, boxes or interaction
images, and bodies that move with their tag; -3 to 25 dB, 12 to 180 views. {scenes} scenes, {empty} of them
without reflectors. Recall counts every reflector, also those below the noise.

At the threshold at which {rate:g} % of these images without reflectors show one:

| method | recall | precision | false in empty | rms |
|---|---|---|---|---|
{methods}

The network at the thresholds that it is shipped with, which were set on other scenes (validation split):

| threshold for | recall | precision | false in empty | rms |
|---|---|---|---|---|
{shipped}

The network takes {milliseconds:.1f} ms of processor time per image on one thread (median). The model card,
`models/detector/README.md`, has its figures for each condition.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=400)
    parser.add_argument(
        "--pfa", type=float, default=0.03, help="share of empty images with a false reflector"
    )
    parser.add_argument("--write", action="store_true", help="write docs/results/detector.md")
    arguments = parser.parse_args()
    detector = Detector.shipped()
    results: dict[str, list[Outcome]] = {"BP, local maxima": [], "scans, CLEAN": [], "BP, network": []}
    seconds = []
    for i in range(arguments.scenes):
        scene = draw_scene(SEED_BASES["test"] + i)
        scans = focused_scans(scene.capture, "bp")
        seen = NetworkInput.of(backproject(scans, GRID), scans)
        start = time.process_time()
        cells = detector.detect(seen, pfa=1.0)
        seconds.append(time.process_time() - start)
        for name, found in (
            ("BP, local maxima", local_maxima(seen)),
            ("scans, CLEAN", cleaned(scene.capture)),
            ("BP, network", list(cells.detections)),
        ):
            results[name].append(score(found, scene.reflectors_m))
    network = results["BP, network"]
    command = f"python tests/benchmarks/bench_detector.py --scenes {arguments.scenes} --write"
    text = TEXT.format(
        head=heading("Finding reflectors among ghosts", command, "of the test split, which no training uses"),
        scenes=arguments.scenes,
        empty=sum(o.missed + sum(o.hits) == 0 for o in network),
        rate=100 * arguments.pfa,
        methods="\n".join(row(name, o, threshold_at(o, arguments.pfa)) for name, o in results.items()),
        shipped="\n".join(
            row(f"{100 * pfa:g} % of empty images", network, detector.contract.threshold(pfa))
            for pfa in SHIPPED
        ),
        milliseconds=1e3 * np.median(seconds),
    )
    print(text)
    if arguments.write:
        (RESULTS / "detector.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
