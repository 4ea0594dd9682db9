"""Which scenes train, validate and test the detector, for a size of dataset.

One place, so that no command can take a scene for testing that another has trained on.
"""

from __future__ import annotations

from train.dataset import Plan


def plans(scenes: int, ats_every: int = 4) -> dict[str, Plan]:
    """The three splits: the scenes to train on, a tenth as many to validate on, as many again to test on."""
    few = max(1, scenes // 10)
    return {
        "train": Plan("train", scenes, ats_every),
        "validation": Plan("validation", few, ats_every),
        "test": Plan("test", few, ats_every),
    }
