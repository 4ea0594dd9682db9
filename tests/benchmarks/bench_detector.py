"""Who finds reflectors among ghosts: local maxima, CLEAN in the scans, the network; and the network's time.

Run `python tests/benchmarks/bench_detector.py --scenes 400`; it prints docs/results/detector.md. The
scenes are the detector's test split (never trained or calibrated on).
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# train/ is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from tagid.imaging.backprojection import backproject
from tagid.tags.network.detector import Detection, Detector
from tagid.tags.network.planes import GRID, NetworkInput
from tagid.tags.reading.reflectors import find_reflectors
from train.dataset import SEED_BASES
from train.evaluate import Figures, Outcome, local_maxima, score, threshold_at
from train.images import focused_scans
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=400)
    parser.add_argument(
        "--pfa", type=float, default=0.03, help="share of empty images with a false reflector"
    )
    arguments = parser.parse_args()
    detector = Detector.shipped()
    results: dict[str, list[Outcome]] = {"BP, local maxima": [], "scans, CLEAN": [], "BP, network": []}
    seconds = []
    for i in range(arguments.scenes):
        scene = draw_scene(SEED_BASES["test"] + i)
        scans = focused_scans(scene.capture, "bp")
        seen = NetworkInput.of(backproject(scans, GRID), scans)
        start = time.perf_counter()
        cells = detector.detect(seen, pfa=1.0)
        seconds.append(time.perf_counter() - start)
        for name, found in (
            ("BP, local maxima", local_maxima(seen)),
            ("scans, CLEAN", cleaned(scene.capture)),
            ("BP, network", list(cells.found)),
        ):
            results[name].append(score(found, scene.reflectors_m))
    print(
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}.", end=" "
    )
    print(f"Date: {datetime.now(UTC):%Y-%m-%d}. Command: `python {' '.join(sys.argv)}`\n")
    rate = f"{100 * arguments.pfa:g} %"
    print(f"{arguments.scenes} scenes, thresholds for a false reflector in {rate} of empty images\n")
    print("| method | recall | precision | false in empty | rms |\n|---|---|---|---|---|")
    for name, outcomes in results.items():
        print(row(name, outcomes, threshold_at(outcomes, arguments.pfa)))
    print(f"\nThe network takes {1e3 * np.median(seconds):.1f} ms an image (median, one thread).")


if __name__ == "__main__":
    main()
