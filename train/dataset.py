"""Images and truths on disk, in shards that survive a kill: a shard is there whole or not at all.

Scene i of a dataset comes from seed base + i alone, so that any machine and any number of processes make the
same dataset, and what was made is never made again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tagid import processes
from tagid.capture import Capture
from tagid.errors import StorageError, UsageError
from tagid.files import make_folder, read_bytes, replacing, write_bytes
from tagid.imaging.autofocus import focus_axis_distance
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from train.distributions import Distribution
from train.planes import GRID, NetworkInput
from train.scenes import draw_scene

METHODS = ("bp", "ats")
SHARD = 100
MOST_REFLECTORS = 8
MOST_GHOSTS = 24
SEED_BASES = {"train": 0, "validation": 10_000_000, "test": 20_000_000}
"""First seed of each split; none of them is used by the tests or benchmarks."""
SCENES, ATS_EVERY = 6000, 4
_SIZE = "dataset.json"


@dataclass(frozen=True)
class ImageOf:
    """One image of a dataset: the seed of its scene, and the imaging method."""

    seed: int
    method: str


@dataclass(frozen=True)
class DatasetPlan:
    """Which scenes a dataset holds.

    Attributes:
        split: "train", "validation" or "test".
        scenes: how many.
        ats_every: every so many-th scene is imaged by ATS too; 0 for none.
    """

    split: str
    scenes: int
    ats_every: int = 4

    def __post_init__(self) -> None:
        if self.split not in SEED_BASES:
            raise UsageError(f"split {self.split!r} is unknown", f"Use {', '.join(SEED_BASES)}.")
        if not 1 <= self.scenes < 10_000_000 or self.ats_every < 0:
            raise UsageError(f"{self.scenes} scenes, ATS every {self.ats_every}", "Give positive numbers.")

    @property
    def shards(self) -> int:
        return -(-self.scenes // SHARD)

    def images(self, shard: int) -> list[ImageOf]:
        cells = []
        for i in range(shard * SHARD, min((shard + 1) * SHARD, self.scenes)):
            seed = SEED_BASES[self.split] + i
            cells.append(ImageOf(seed, METHODS[0]))
            if self.ats_every and i % self.ats_every == 0:
                cells.append(ImageOf(seed, METHODS[1]))
        return cells


@dataclass(frozen=True)
class Size:
    """Size of a dataset, which its folder remembers: `scenes` and `ats_every` of `DatasetPlan`."""

    scenes: int = SCENES
    ats_every: int = ATS_EVERY

    def remember(self, work: Path) -> None:
        """Write it into the folder of the dataset, which is made if it is not there. Raises StorageError."""
        make_folder(work)
        write_bytes(work / _SIZE, (json.dumps(asdict(self)) + "\n").encode())

    @classmethod
    def of(cls, work: Path, scenes: int | None, ats_every: int | None) -> Size:
        """What is given, and else that of the dataset in the folder. Raises StorageError."""
        stored = cls()
        if not work.is_dir():
            raise StorageError(f"{work} holds no dataset", "Make one with `python -m train dataset`.")
        if (work / _SIZE).exists():
            try:
                stored = cls(**json.loads(read_bytes(work / _SIZE)))
            except (ValueError, TypeError) as error:
                raise StorageError(f"{work / _SIZE}: {error}", "Make the dataset again.") from error
        return cls(
            stored.scenes if scenes is None else scenes,
            stored.ats_every if ats_every is None else ats_every,
        )


def plans(scenes: int, ats_every: int = 4) -> dict[str, DatasetPlan]:
    """The three splits: the scenes to train on, a tenth as many to validate on, as many again to test on.

    In one place, so that no command can take a scene for testing that another has trained on.
    """
    few = max(1, scenes // 10)
    return {
        "train": DatasetPlan("train", scenes, ats_every),
        "validation": DatasetPlan("validation", few, ats_every),
        "test": DatasetPlan("test", few, ats_every),
    }


@dataclass(frozen=True, eq=False)
class Samples:
    """Images with their truths; n of them.

    Attributes:
        relative: (n, 2, 96, 96) float16, real and imaginary part over the brightest pixel.
        snr_db, views, method: (n,) of the image; method is an index into `METHODS`.
        reflectors: (n, 8, 2) m, nan where there are fewer.
        ghosts: (n, 24, 3) x, y, ring radius, m, nan where there are fewer.
        scene_snr_db: (n,) of the recording.
    """

    relative: NDArray[np.float16]
    snr_db: NDArray[np.float32]
    views: NDArray[np.int32]
    method: NDArray[np.int8]
    reflectors: NDArray[np.float32]
    ghosts: NDArray[np.float32]
    scene_snr_db: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.relative)

    def part(self, keep: NDArray[np.bool_] | slice) -> Samples:
        return Samples(**{name: value[keep] for name, value in vars(self).items()})


def focused_scans(capture: Capture, method: str) -> BasebandScans:
    """Preprocessed scans under the axis distance that focuses them, as in `tagid.pipeline.reconstruct`."""
    settings = PreprocessSettings(matched_filter=False, extent_m=GRID.extent)
    focused, _ = focus_axis_distance(preprocess(capture, settings=settings), GRID)
    if method != "bp":
        return focused
    matched = preprocess(capture, settings=replace(settings, matched_filter=True))
    return matched.with_aperture(focused.aperture)


def network_input(capture: Capture, method: str, seed: int = 0) -> NetworkInput:
    """The network's input for one capture and method, "bp" or "ats"."""
    if method not in METHODS:
        raise UsageError(f"the detector is not trained on {method!r}", f"Use {' or '.join(METHODS)}.")
    scans = focused_scans(capture, method)
    if method == "bp":
        return NetworkInput.of(backproject(scans, GRID), scans)
    from tagid.imaging.ats.fit import fit
    from tagid.imaging.ats.settings import AtsSettings

    return NetworkInput.of(fit(scans, GRID, AtsSettings(seed=seed)).image, scans)


def _sample(image: ImageOf, distribution: Distribution) -> Samples:
    scene = draw_scene(image.seed, distribution)
    seen = network_input(scene.capture, image.method, image.seed % 1000)
    reflectors = np.full((1, MOST_REFLECTORS, 2), np.nan, dtype=np.float32)
    reflectors[0, : len(scene.reflectors_m)] = scene.reflectors_m
    ghosts = np.full((1, MOST_GHOSTS, 3), np.nan, dtype=np.float32)
    for j, ghost in enumerate(scene.ghosts[:MOST_GHOSTS]):
        ghosts[0, j] = *ghost.centre_m, ghost.radius_m
    return Samples(
        np.array([[seen.relative.real, seen.relative.imag]], dtype=np.float16),
        np.array([seen.snr_db], dtype=np.float32),
        np.array([seen.views], dtype=np.int32),
        np.array([METHODS.index(image.method)], dtype=np.int8),
        reflectors,
        ghosts,
        np.array([scene.snr_db], dtype=np.float32),
    )


Map = Callable[[Callable[[ImageOf], Samples], Iterable[ImageOf]], Iterable[Samples]]
"""Maps a function over images in order, as `map` does, perhaps in several processes."""


def make_shard(images: list[ImageOf], distribution: Distribution, mapped: Map = map) -> Samples:
    """The images of one shard with their truths."""
    return _joined(list(mapped(partial(_sample, distribution=distribution), images)))


def _joined(parts: list[Samples]) -> Samples:
    names = Samples.__dataclass_fields__
    return Samples(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def build(
    folder: Path,
    plan: DatasetPlan,
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Make the shards that are not there yet; `progress` is called with (images made, images).

    Raises:
        UsageError: the folder holds a dataset of another kind. StorageError: it cannot be written.
    """
    dist = Distribution()
    settings = {"distribution": dist.fingerprint(), "ats_every": plan.ats_every, "shard": SHARD}
    about = folder / plan.split / "about.json"
    try:
        about.parent.mkdir(parents=True, exist_ok=True)
        if about.exists() and json.loads(about.read_text()) != settings:
            raise UsageError(f"{about.parent} holds a dataset of another kind", "Choose another folder.")
        about.write_text(json.dumps(settings) + "\n")
    except (OSError, ValueError) as error:
        raise StorageError(f"{about}: {error}", "Choose a folder that can be written.") from error
    shards = [plan.images(shard) for shard in range(plan.shards)]
    paths = [about.parent / f"{shard:04d}-{len(images)}.npz" for shard, images in enumerate(shards)]
    total = sum(map(len, shards))
    done = sum(len(images) for images, path in zip(shards, paths, strict=True) if path.exists())
    if progress:
        progress(done, total)
    with processes.spawn_context().Pool(jobs) as pool:

        def counted(function: Callable[[ImageOf], Samples], images: Iterable[ImageOf]) -> Iterator[Samples]:
            nonlocal done
            for sample in pool.imap(function, images):
                done += 1
                if progress:
                    progress(done, total)
                yield sample

        for images, path in zip(shards, paths, strict=True):
            if not path.exists():
                made = make_shard(images, dist, counted)
                with replacing(path) as file:
                    np.savez(file, **vars(made))


def load(folder: Path, plan: DatasetPlan) -> Samples:
    """All samples of a plan, in order.

    Raises StorageError if a shard is missing or damaged.
    """

    def shards() -> Iterator[Samples]:
        for shard in range(plan.shards):
            path = folder / plan.split / f"{shard:04d}-{len(plan.images(shard))}.npz"
            try:
                with np.load(path, allow_pickle=False) as file:
                    yield Samples(**{name: file[name] for name in Samples.__dataclass_fields__})
            except (OSError, ValueError, KeyError) as error:
                raise StorageError(f"{path}: {error}", "Make it with `python -m train dataset`.") from error

    return _joined(list(shards()))
