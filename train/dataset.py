"""Images and truths on disk, in shards that survive a kill: a shard is there whole or not at all.

Scene i of a dataset comes from seed base + i alone, so that any machine and any number of processes make the
same dataset, and what was made is never made again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tagid import processes
from tagid.capture import Capture
from tagid.errors import StorageError, UsageError
from tagid.files import make_folder, read_bytes, replacing, write_bytes
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.autofocus import focus_axis_distance
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
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


class ImageOf(NamedTuple):
    """One image of a dataset: the seed of its scene, and the imaging method."""

    seed: int
    method: str


@dataclass(frozen=True)
class DatasetPlan:
    """Scenes of a split, of which every so many-th is imaged by ATS too; 0 for none."""

    split: str
    scenes: int
    ats_every: int = ATS_EVERY

    def __post_init__(self) -> None:
        if not 1 <= self.scenes < 10_000_000 or self.ats_every < 0:
            raise UsageError(f"{self.scenes} scenes, ATS every {self.ats_every}", "Give positive numbers.")

    def shards(self, folder: Path) -> dict[Path, list[ImageOf]]:
        """The file of every shard, and its images."""
        shards = {}
        for number, first in enumerate(range(0, self.scenes, SHARD)):
            images = []
            for i in range(first, min(first + SHARD, self.scenes)):
                methods = METHODS if self.ats_every and i % self.ats_every == 0 else METHODS[:1]
                images += [ImageOf(SEED_BASES[self.split] + i, method) for method in methods]
            shards[folder / self.split / f"{number:04d}-{len(images)}.npz"] = images
        return shards


@dataclass(frozen=True)
class Size:
    """Size of a dataset, which its folder remembers: `scenes` and `ats_every` of the split to train on."""

    scenes: int = SCENES
    ats_every: int = ATS_EVERY

    def remember(self, work: Path) -> None:
        """Write it into the folder of the dataset, which is made if it is not there. Raises StorageError."""
        make_folder(work)
        write_bytes(work / _SIZE, (json.dumps(asdict(self)) + "\n").encode())

    @classmethod
    def of(cls, work: Path) -> Size:
        """That of the dataset in the folder. Raises StorageError."""
        try:
            return cls(**json.loads(read_bytes(work / _SIZE)))
        except (StorageError, ValueError, TypeError) as error:
            raise StorageError(
                f"{work} holds no dataset: {error}", "Make one with `python -m train dataset`."
            ) from error

    def plans(self) -> dict[str, DatasetPlan]:
        """The scenes to train on, a tenth as many to validate on, as many again to test on.

        In one place, so that no command can take a scene for testing that another has trained on.
        """
        few = max(1, self.scenes // 10)
        counts = {"train": self.scenes, "validation": few, "test": few}
        return {split: DatasetPlan(split, count, self.ats_every) for split, count in counts.items()}


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

    @classmethod
    def joined(cls, parts: Iterable[Samples]) -> Samples:
        """All of some samples."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*map(np.concatenate, columns))


def network_input(capture: Capture, method: str, seed: int = 0) -> NetworkInput:
    """The network's input: "bp" or "ats" under the axis distance that focuses, as `tagid reconstruct`."""
    settings = PreprocessSettings(matched_filter=False, extent_m=GRID.extent)
    scans, _ = focus_axis_distance(preprocess(capture, settings=settings), GRID)
    if method == "ats":
        return NetworkInput.of(fit(scans, GRID, AtsSettings(seed=seed)).image, scans)
    matched = preprocess(capture, settings=replace(settings, matched_filter=True))
    scans = matched.with_aperture(scans.aperture)
    return NetworkInput.of(backproject(scans, GRID), scans)


def sample(image: ImageOf, distribution: Distribution) -> Samples:
    """One image with its truth."""
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


def build(
    folder: Path,
    plan: DatasetPlan,
    jobs: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
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
    shards = plan.shards(folder)
    missing = {path: images for path, images in shards.items() if not path.exists()}
    waiting = [image for images in missing.values() for image in images]
    total = sum(map(len, shards.values()))
    progress(total - len(waiting), total)
    with processes.spawn_context().Pool(jobs) as pool:
        samples = enumerate(pool.imap(partial(sample, distribution=dist), waiting), total - len(waiting) + 1)
        for path, images in missing.items():
            parts = []
            for done, made in islice(samples, len(images)):
                parts.append(made)
                progress(done, total)
            with replacing(path) as file:
                np.savez(file, **vars(Samples.joined(parts)))


def load(folder: Path, plan: DatasetPlan) -> Samples:
    """All samples of a plan, in order. Raises StorageError if a shard is missing or damaged."""
    parts = []
    for path in plan.shards(folder):
        try:
            with np.load(path, allow_pickle=False) as file:
                parts.append(Samples(**{name: file[name] for name in Samples.__dataclass_fields__}))
        except (OSError, ValueError, KeyError) as error:
            raise StorageError(f"{path}: {error}", "Make it with `python -m train dataset`.") from error
    return Samples.joined(parts)
