"""Which scenes train, validate and test the detector, for a size of dataset.

One place, so that no command can take a scene for testing that another has trained on.
"""

from __future__ import annotations

from train.dataset import DatasetPlan


def plans(scenes: int, ats_every: int = 4) -> dict[str, DatasetPlan]:
    """The three splits: the scenes to train on, a tenth as many to validate on, as many again to test on."""
    few = max(1, scenes // 10)
    return {
        "train": DatasetPlan("train", scenes, ats_every),
        "validation": DatasetPlan("validation", few, ats_every),
        "test": DatasetPlan("test", few, ats_every),
    }
