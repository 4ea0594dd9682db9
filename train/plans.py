"""Which scenes train, validate and test the detector, for a size of dataset.

One place, so that no command can take a scene for testing that another has trained on.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from tagid.errors import StorageError
from tagid.files import make_folder, read_bytes, write_bytes
from train.dataset import DatasetPlan

SCENES, ATS_EVERY = 6000, 4
_NAME = "dataset.json"


@dataclass(frozen=True)
class Size:
    """Size of a dataset, which its folder remembers: `scenes` and `ats_every` of `DatasetPlan`."""

    scenes: int = SCENES
    ats_every: int = ATS_EVERY

    def remember(self, work: Path) -> None:
        """Write it into the folder of the dataset, which is made if it is not there. Raises StorageError."""
        make_folder(work)
        write_bytes(work / _NAME, (json.dumps(asdict(self)) + "\n").encode())

    @classmethod
    def of(cls, work: Path, scenes: int | None, ats_every: int | None) -> Size:
        """What is given, and else that of the dataset in the folder. Raises StorageError."""
        stored = cls()
        if not work.is_dir():
            raise StorageError(f"{work} holds no dataset", "Make one with `python -m train dataset`.")
        if (work / _NAME).exists():
            try:
                stored = cls(**json.loads(read_bytes(work / _NAME)))
            except (ValueError, TypeError) as error:
                raise StorageError(f"{work / _NAME}: {error}", "Make the dataset again.") from error
        return cls(
            stored.scenes if scenes is None else scenes,
            stored.ats_every if ats_every is None else ats_every,
        )


def plans(scenes: int, ats_every: int = 4) -> dict[str, DatasetPlan]:
    """The three splits: the scenes to train on, a tenth as many to validate on, as many again to test on."""
    few = max(1, scenes // 10)
    return {
        "train": DatasetPlan("train", scenes, ats_every),
        "validation": DatasetPlan("validation", few, ats_every),
        "test": DatasetPlan("test", few, ats_every),
    }
