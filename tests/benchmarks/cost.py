"""What imaging costs: seconds of BP, FISTA and ATS, how they grow, what they are spent on, and both engines.

One scene of 4 points with noise 0.316, 0.7 m, radar at 1 m. "wall" is the best of the repetitions; "CPU" is
the time of that process, which other load disturbs less; set-up is in all of them, preprocessing is not. The
engines run in processes of their own, from the same seed, and report their peak resident memory.
"""

from __future__ import annotations

import ctypes
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import resample

from tagid.capture import Capture
from tagid.geometry import ImageGrid
from tagid.imaging.ats.adapt import fit_adapted
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.fit_native import OnnxEngine
from tagid.imaging.ats.problem import FieldShape, FineRange, GridArrays, draw_weights, view_arrays
from tagid.imaging.ats.settings import AtsSettings, FitSettings
from tagid.imaging.backprojection import backproject
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.sparse import SparseSettings, sparse_recovery
from tagid.imaging.types import BasebandScans
from tagid.pipeline.prepared import as_prepared
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tagid.storage.hdf5 import write_capture
from tests.benchmarks.heldout import Task, capture_of
from tests.benchmarks.imaging_scenes import point_problem
from tests.benchmarks.imaging_unknowns import RAILS, RailCell, rail_capture
from tests.benchmarks.measure import best, timed
from tests.benchmarks.pictures import curves
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

EXTENT_M = 0.7
WORKS: dict[str, Callable[..., object]] = {"BP": backproject, "FISTA": sparse_recovery, "ATS": fit}
VIEWS, PIXELS, OVERSAMPLINGS = (12, 36, 120, 360), (48, 96, 128, 192), (1.5, 3.0, 6.0)


def scans(views: int, oversampling: float = 1.5, matched: bool = False) -> BasebandScans:
    """Scans of 4 points, the same for every call."""
    rng = np.random.default_rng(77)
    capture = point_problem(rng.uniform(-0.22, 0.22, (4, 2)), views, 0.316, rng).capture
    how = PreprocessSettings("none", matched, extent_m=EXTENT_M, oversampling=oversampling)
    return preprocess(capture, settings=how)


def _repeats(run: Run) -> int:
    """How often a time is taken; the seeds of the page are none but the scene's."""
    run.seeds = "77, one scene"
    return run.number(9, 3)


def image_times(run: Run) -> Iterator[Table]:
    """The sizes that the targets of speed are stated for.

    Every round times all of them once, so that a processor whose clock changes slows all alike.
    """
    repeats = _repeats(run)
    sizes = (("BP", 360, 128), ("FISTA", 36, 96), ("ATS", 36, 96), ("ATS", 360, 96))
    works = [
        partial(WORKS[name], scans(views, matched=name == "BP"), ImageGrid(EXTENT_M, pixels))
        for name, views, pixels in sizes
    ]
    rounds = np.array([[best(work, 1) for work in works] for _ in range(repeats)])
    rows = []
    for (name, views, pixels), (wall, cpu) in zip(sizes, rounds.min(axis=0), strict=True):
        rows.append([name, str(views), f"{pixels} x {pixels}", f"{wall * 1e3:.1f}", f"{cpu * 1e3:.1f}"])
    rows.append(["BP, error", "360", "128 x 128", f"{backprojection_error() * 100:.2f} %", ""])
    yield Table("method | views | pixels | wall (ms) | CPU (ms)", rows, f"One scene, best of {repeats}.")


PLAIN = Path(__file__).with_name("plain_backprojection.cpp")


def rivals(run: Run) -> Iterator[Table]:
    """The same images by other programs and by each other, in turn, so that load slows all alike."""
    repeats = _repeats(run)
    wide, few = scans(360, oversampling=6.0, matched=True), scans(36)
    large, small = ImageGrid(EXTENT_M, 128), ImageGrid(EXTENT_M, 96)
    plain = _plain_backprojection(run.folder, wide, large)
    exact, image = plain(), backproject(wide, large).values.ravel()
    alike = abs(np.vdot(exact, image)) / (np.linalg.norm(exact) * np.linalg.norm(image))
    assert alike > 0.99, f"the two images correlate by {alike:.3f}"
    fista = partial(sparse_recovery, few, small)
    rows = []
    for name, ours, other, theirs in (
        ("BP, 360 views, 128 x 128", partial(backproject, wide, large), "plain C++ with OpenMP", plain),
        ("FISTA, 36 views, 96 x 96", fista, "PyLops", _pylops(few, small)),
        ("ATS, 36 views, 96 x 96", partial(fit, few, small), "FISTA", fista),
    ):
        rounds = [(best(ours, 1)[0], best(theirs, 1)[0]) for _ in range(repeats)]
        first, two = (min(times) for times in zip(*rounds, strict=True))
        ratio, word = max(two / first, first / two), "faster" if first < two else "slower"
        rows.append([name, f"{first * 1e3:.1f}", other, f"{two * 1e3:.1f}", f"{ratio:.1f}", word])
        run.say(str(rows[-1]))
    heading = "image | wall (ms) | beside | wall (ms) | ratio | tagid is"
    yield Table(heading, rows, f"One scene, best of {repeats}, wall clock, all cores.")


def _plain_backprojection(folder: Path, raw: BasebandScans, grid: ImageGrid) -> Callable[[], np.ndarray]:
    """The kernel of `plain_backprojection.cpp` on scans."""
    library = folder / "plain.so"
    words = ["c++", "-shared", "-fPIC", "-O3", "-march=native", "-ffast-math", "-fopenmp", "-o"]
    subprocess.run([*words, library, PLAIN], check=True)
    loaded = ctypes.CDLL(str(library))
    antennas = np.ascontiguousarray(raw.aperture.positions, dtype=np.float32)
    points = np.ascontiguousarray(grid.points, dtype=np.float32)
    rows = np.ascontiguousarray(raw.samples)
    out = np.zeros(len(points), dtype=np.complex64)
    numbers = [ctypes.c_float(value) for value in (raw.range_start_m, raw.range_step_m, raw.wavenumber)]

    def run() -> np.ndarray:
        loaded.backproject(
            rows.ctypes, antennas.ctypes, *rows.shape, *numbers, points.ctypes, len(points), out.ctypes
        )
        return out

    return run


def _pylops(raw: BasebandScans, grid: ImageGrid) -> Callable[[], object]:
    """FISTA of PyLops on the operator as a sparse matrix: the same problem, step and end."""
    import pylops
    from pylops.optimization.sparsity import fista
    from scipy import sparse

    operator, settings = ForwardOperator(raw, grid), SparseSettings()
    image = sparse_recovery(raw, grid)
    units = (operator.among(np.arange(operator.points) == point) for point in range(operator.points))
    columns = [sparse.csc_array(unit.forward(np.ones(1)).reshape(-1, 1)) for unit in units]
    matrix = pylops.MatrixMult(sparse.hstack(columns, format="csr"), dtype="complex64")
    # Its problem is ||y - A x||^2 + eps ||x||_1, and its end an absolute change.
    return partial(
        fista,
        matrix,
        raw.samples.ravel(),
        niter=settings.iterations,
        eps=2 * image.settings["lambda"],
        alpha=1 / (1.1 * operator.norm_squared),
        tol=settings.tolerance * float(np.linalg.norm(image.values)),
    )


def backprojection_error() -> float:
    """Largest error of an image of 360 views against the sum written out in double precision."""
    grid, raw = ImageGrid(EXTENT_M, 128), scans(360, matched=True)
    image = backproject(raw, grid).values.ravel()
    factor = 64
    fine = resample(raw.samples.astype(complex), raw.samples.shape[1] * factor, axis=1)
    total = np.zeros(len(grid.points), dtype=complex)
    for row, (x, y, z) in zip(fine, raw.aperture.positions, strict=True):
        distance = np.sqrt((grid.points[:, 0] - x) ** 2 + (grid.points[:, 1] - y) ** 2 + z**2)
        at = (distance - raw.range_start_m) / raw.range_step_m * factor
        bins = np.arange(len(row))
        value = np.interp(at, bins, row.real) + 1j * np.interp(at, bins, row.imag)
        total += value * np.exp(2j * raw.wavenumber * distance)
    inside = np.hypot(*grid.points.T) < 0.4
    return float(np.abs(image - total / len(fine))[inside].max() / np.abs(total / len(fine)).max())


def shares(views: int, pixels: int, oversampling: float, repeats: int) -> tuple[float, float, float]:
    """CPU seconds of one ATS step: network and Adam, sums over views and pixels, products over range bins."""
    raw, grid = scans(views, oversampling), ImageGrid(EXTENT_M, pixels)
    shape = FieldShape.of(grid, raw.wavelength_m, 1)
    numbers = np.array([1e-4, 1, 1, 1, 1e-3, 1e-4, 1e-5], dtype=np.float32)
    engine = OnnxEngine(draw_weights(shape, grid, 1.0, 0))
    count = min(views, FitSettings().views_per_step)

    def step(views_of_it: int, grid_of_it: ImageGrid = grid) -> float:
        fine = FineRange.of(raw, grid.points)
        arrays = GridArrays.of(grid_of_it, shape.cells)
        ones = np.ones(raw.samples.shape)
        whole = view_arrays(raw, grid_of_it.points, fine, ones, np.ones((views, 1), dtype=complex))
        part = whole.select(slice(0, views_of_it))
        return best(lambda: engine.step(arrays, part, fine, numbers), repeats)[1]

    all_of_it, one_view = step(count), step(1)
    sums = (all_of_it - one_view) * count / max(count - 1, 1)
    few = ImageGrid(EXTENT_M, 4)
    products = (step(count, few) - step(1, few)) * count / max(count - 1, 1)
    products = float(np.clip(products, 0, sums))
    return max(all_of_it - sums, 0.0), sums - products, products


def growth(run: Run) -> Iterator[Table]:
    repeats = _repeats(run)
    cases = [("views", (v, 96, 1.5)) for v in VIEWS]
    cases += [("pixels", (36, p, 1.5)) for p in PIXELS]
    cases += [("bins", (36, 96, o)) for o in OVERSAMPLINGS]
    rows, plotted = [], dict[str, list[tuple[float, dict[str, float]]]]()
    for kind, (views, pixels, oversampling) in cases[:: 2 if run.quick else 1]:
        grid, raw = ImageGrid(EXTENT_M, pixels), scans(views, oversampling)
        seconds = {
            name: best(partial(work, raw, grid), repeats if name == "BP" else max(1, repeats // 3))[1]
            for name, work in WORKS.items()
        }
        parts = shares(views, pixels, oversampling, repeats)
        names = ("network and Adam", "sums over views and pixels", "products over range bins")
        shown = [f"{1e3 * v:.1f}" for v in seconds.values()] + [f"{1e3 * p:.2f}" for p in parts]
        bins = raw.samples.shape[1]
        size = [kind, str(views), f"{pixels} x {pixels}", str(bins)]
        rows.append([*size, *shown, names[int(np.argmax(parts))]])
        at = {"views": views, "pixels": pixels**2, "bins": bins}[kind]
        plotted.setdefault(kind, []).append((float(at), seconds))
        run.say(str(rows[-1]))
    figures = []
    for kind, result in plotted.items() if run.pictures else ():
        lines = {name: [np.log10(1e3 * s[name]) for _, s in result] for name in WORKS}
        x, path = [float(np.log10(at)) for at, _ in result], run.pictures / f"cost-{kind}.png"
        curves(x, lines, (f"log10 {kind}", "log10 CPU ms"), path, f"Cost over {kind}")
        figures.append(f"![Time against {kind}](../pictures/{path.name})")
    columns = (
        "varied | views | pixels | bins | BP (ms) | FISTA (ms) | ATS (ms) | network | sums | "
        "products (ms a step) | bottleneck of ATS"
    )
    yield Table(columns, rows, f"One scene, best of {repeats}.", below="\n".join(figures))


_ENGINE = """
import pickle, resource, sys, time, numpy as np
from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings
raw, grid = pickle.load(open({scene!r}, "rb")), ImageGrid({extent}, 96)
seconds = []
for _ in range({repeats}):
    used = time.process_time()
    image = fit(raw, grid, AtsSettings(engine={engine!r})).image.values
    seconds.append(time.process_time() - used)
np.save({out!r}, image)
print(min(seconds), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def engines(run: Run) -> Iterator[Table]:
    """Both engines from the same weights: seconds, peak memory of the process, difference of the images."""
    repeats = max(2, _repeats(run) // 3)
    rows, scene, out = [], str(run.folder / "scene"), str(run.folder / "image.npy")
    for views in (36, 360):
        figures, images = [], []
        Path(scene).write_bytes(pickle.dumps(scans(views)))
        for engine in ("torch", "onnx"):
            what = {"scene": scene, "extent": EXTENT_M, "repeats": repeats, "engine": engine, "out": out}
            words = [sys.executable, "-c", _ENGINE.format(**what)]
            done = subprocess.run(words, capture_output=True, text=True, check=True)
            figures.append([float(word) for word in done.stdout.split()])
            images.append(np.load(out))
        (torch_s, torch_mb), (onnx_s, onnx_mb) = figures
        difference = float(np.linalg.norm(images[0] - images[1]) / np.linalg.norm(images[0]))
        seconds = [f"{torch_s:.2f}", f"{onnx_s:.2f}", f"{onnx_s / torch_s:.2f}"]
        memory = [f"{torch_mb:.0f}", f"{onnx_mb:.0f}", f"{onnx_mb / torch_mb:.2f}"]
        rows.append([str(views), *seconds, *memory, f"{100 * difference:.2f} %"])
    columns = "views | torch (CPU s) | onnx (CPU s) | ratio | torch (MB) | onnx (MB) | ratio | difference"
    yield Table(columns, rows, f"One scene, best of {repeats}.")


SCENES = (
    ("reflectors", "P440"),
    ("round can", "P440"),
    ("box", "P440"),
    ("shell with reflectors", "P440"),
    ("free30_c90", "full wave"),
    ("can30_c180", "full wave"),
)
"""Of `heldout.py`."""
SCENE_SEED = 8000


def priors(run: Run) -> Iterator[Table]:
    """What coupled pixels cost beside FISTA, and what they bring on unseen views; each scene once."""
    run.seeds = str(SCENE_SEED)
    rows = []
    for (family, radar), views in product(SCENES, (12, 36, 120)) if not run.quick else [(SCENES[0], 36)]:
        capture, extent = capture_of(Task(family, radar, views, SCENE_SEED))
        settings = ImagingSettings(method="ats", extent_m=extent, pixels=96, focus_m=0.0)
        prepared = as_prepared(capture, settings)
        prepared.choose_pulse(None)
        raw = prepared.scans(settings.preprocessing_for_focus(prepared.given, matched_filter=False))
        grid = ImageGrid(extent, 96)
        works = (
            partial(sparse_recovery, raw, grid),
            partial(fit, raw, grid),
            partial(fit_adapted, raw, grid, AtsSettings()),
        )
        took = [timed(work)[2] for work in works]
        sparse, ats = (
            reconstruct(capture, replace(settings, method=method)).image.settings
            for method in ("sparse", "ats")
        )
        shares = [ats["held_out"][key] for key in ("noise", "backprojection")]
        shares += [facts["held_out"]["residual"] for facts in (sparse, ats)]
        times = [*(f"{1e3 * t:.0f}" for t in took), *(f"{t / took[0]:.1f}" for t in took[1:])]
        prior = ats.get("prior", "default")
        percent = ("-" if share is None else f"{100 * share:.1f}" for share in shares)
        rows.append([f"{family}, {radar}", str(views), *times, prior, *percent])
        run.say(str(rows[-1]))
    columns = (
        "scene | views | FISTA (ms) | one fit (ms) | ATS (ms) | fit / FISTA | ATS / FISTA | "
        "prior | noise (%) | backprojection (%) | FISTA (%) | ATS (%)"
    )
    yield Table(columns, rows, shown=lambda row: row[1] == "36")


def echoed(capture: Capture) -> Capture:
    """The capture as a pulse records it that rings on: with echoes of itself 0.12 and 0.27 m later."""
    samples = capture.samples.copy()
    for later_m, strength in ((0.12, 0.5), (0.27, -0.3)):
        bins = round(later_m / capture.range_step_m)
        samples[:, bins:] += strength * capture.samples[:, :-bins]
    return replace(capture, samples=samples)


def pulse_estimates(run: Run) -> Iterator[Table]:
    """Whole images with `--pulse estimate` against those without; each scene once."""
    run.seeds = "77, and 0 of the rail"
    rng = np.random.default_rng(77)
    points = rng.uniform(-0.22, 0.22, (4, 2))
    turn = {"extent_m": EXTENT_M, "pixels": 96}
    rail, _ = rail_capture(RailCell(RAILS[0], 0, "bp"))
    cases: list[tuple[str, Capture, dict[str, Any]]] = [
        (f"turn, {views} views, 96 x 96", point_problem(points, views, 0.316, rng).capture, turn)
        for views in (36, 360)
    ]
    cases += [
        ("rail, 600 views, about 2.2 m", rail, {"free_extent": True, "free_pixels": True}),
        ("rail, 600 views, 4 m, 256 x 256", rail, {"extent_m": 4.0, "pixels": 256}),
    ]
    rows = []
    for name, capture, size in cases[:1] if run.quick else cases:
        for said, recorded in (("nominal", capture), ("rings", echoed(capture)))[: 1 if run.quick else 2]:
            for method in ("bp", "sparse", "ats"):
                if "256" in name and method != "bp":
                    continue
                settings = [ImagingSettings(method=method, pulse=p, **size) for p in ("nominal", "estimate")]
                results = [timed(partial(reconstruct, recorded, s)) for s in settings]
                estimate, took = results[1][0].pulse, [cpu for *_, cpu in results]
                taken = "yes" if estimate is not None and estimate.taken else "no"
                times = (f"{took[0]:.2f}", f"{took[1]:.2f}", f"{took[1] / took[0]:.1f}")
                rows.append([name, said, method, taken, *times])
                run.say(str(rows[-1]))
    columns = "path | pulse | method | taken | without (s) | with estimate (s) | ratio"
    yield Table(columns, rows, shown=lambda row: str(row[0]).startswith("turn, 36 views"))


def process(run: Run) -> Iterator[Table]:
    repeats, file = max(2, _repeats(run) // 3), run.folder / "scene.tagid.h5"
    rng = np.random.default_rng(77)
    write_capture(file, point_problem(rng.uniform(-0.22, 0.22, (4, 2)), 360, 0.316, rng).capture)
    words = [sys.executable, "-m", "tagid", "reconstruct", str(file), "--method", "bp"]
    took = [timed(partial(subprocess.run, words, capture_output=True, check=True))[1] for _ in range(repeats)]
    row = ("`tagid reconstruct FILE --method bp`, 360 views", f"{min(took):.2f}")
    yield Table("command | wall (s)", [row], f"One scene, best of {repeats}.")
