"""Images and answers of one processor against those of another, from the same captures.

    python tests/benchmarks/arm_images.py make FOLDER          # captures, on any machine
    python tests/benchmarks/arm_images.py run FOLDER OUT.npz   # images and answers, on each
    python tests/benchmarks/arm_images.py compare A.npz B.npz  # the table of docs/results/speed.md

`arm_root.sh` runs it in an emulated 64-bit ARM system.
"""

from __future__ import annotations

import json
import platform
import sys
from pathlib import Path

import numpy as np

from tagid.geometry import ImageGrid
from tagid.imaging import kernel
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.sparse import sparse_recovery
from tagid.loops import unusable
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.hdf5 import write_capture
from tagid.tags.layouts.layout import builtin_layouts

OBJECTS = ("helmet-120", "container-90", "empty")
GRID = ImageGrid(0.5, 96)
_ATS_STEPS = 20


def make(folder: Path) -> None:
    """One capture of 36 views of each object."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(OBJECTS):
        capture, _ = simulate_capture(scene_from_name(name, seed), Acquisition(views=36, snr_db=20.0), seed)
        write_capture(folder / f"{name}.tagid.h5", capture)


def run(folder: Path, out: Path) -> None:
    """Every image and answer of a folder of captures."""
    if unusable():
        raise SystemExit(f"not built: {', '.join(unusable())}")
    results: dict[str, np.ndarray] = {"machine": np.array(platform.machine())}
    layouts = list(builtin_layouts().values())
    captures = {name: load_capture(folder / f"{name}.tagid.h5") for name in OBJECTS}
    for name, capture in captures.items():
        plain = preprocess(capture, settings=PreprocessSettings(matched_filter=False))
        geometry = kernel.RangeGeometry.of(
            plain.aperture, GRID.points, (plain.range_start_m, plain.range_step_m), plain.samples.shape[1]
        )
        results[f"gather {name}"] = geometry.gather(plain.samples)
        results[f"scatter {name}"] = geometry.scatter(np.exp(1j * np.arange(geometry.points)))
    # The rest takes many times as long on an emulated processor: what there is can be compared already.
    np.savez_compressed(out, **results)
    print("sums", flush=True)
    for name, capture in captures.items():
        plain = preprocess(capture, settings=PreprocessSettings(matched_filter=False))
        results[f"bp {name}"] = backproject(preprocess(capture), GRID).values
        results[f"sparse {name}"] = sparse_recovery(plain, GRID).values
        print(f"{name}: images", flush=True)
        answer = identify(PreparedCapture(capture), layouts).to_dict()
        said = {key: answer[key] for key in ("status", "layout", "rotation_deg", "lead")}
        results[f"answer {name}"] = np.array(json.dumps(said))
        print(f"{name}: {answer['status']} {answer['layout'] or ''}", flush=True)
        np.savez_compressed(out, **results)
    first = preprocess(captures[OBJECTS[0]], settings=PreprocessSettings(matched_filter=False))
    results[f"ats {OBJECTS[0]}"] = fit(first, GRID, AtsSettings(steps=_ATS_STEPS)).image.values
    np.savez_compressed(out, **results)


def compare(first: Path, second: Path) -> None:
    """Largest difference of each kind of image, relative to its largest pixel, and of the answers."""
    with np.load(first) as a, np.load(second) as b:
        both = set(a) & set(b)
        print(f"| what | objects | largest difference, {a['machine']} to {b['machine']} |\n|---|---|---|")
        for kind in ("gather", "scatter", "bp", "sparse", "ats"):
            keys = [f"{kind} {name}" for name in OBJECTS if f"{kind} {name}" in both]
            if keys:
                worst = max(float(np.abs(a[key] - b[key]).max() / np.abs(a[key]).max()) for key in keys)
                print(f"| {kind} | {len(keys)} | {worst:.1e} of the largest value |")
        keys = [f"answer {name}" for name in OBJECTS if f"answer {name}" in both]
        pairs = [(json.loads(str(a[key])), json.loads(str(b[key]))) for key in keys]
    if pairs:
        same = sum((x["status"], x["layout"]) == (y["status"], y["layout"]) for x, y in pairs)
        turned = max(abs((x["rotation_deg"] or 0) - (y["rotation_deg"] or 0)) for x, y in pairs)
        print(f"| answer | {len(pairs)} | {same} of {len(pairs)} alike, rotation within {turned:.1e} deg |")


def main() -> None:
    words = sys.argv[1:]
    if len(words) == 2 and words[0] == "make":
        make(Path(words[1]))
    elif len(words) == 3 and words[0] in ("run", "compare"):
        (run if words[0] == "run" else compare)(Path(words[1]), Path(words[2]))
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main()
