"""What made a network: it is stored in the model's file and listed on its card."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch

from tagid._version import __version__
from train.distributions import Distribution


@dataclass(frozen=True)
class Origin:
    """What made a network.

    Attributes:
        commit: of the code; "unknown" outside a checkout.
        seed, epochs: of the training.
        scenes, ats_every: size of the dataset, as in `train.dataset.DatasetPlan`.
        distribution: fingerprint of the scenes' distribution.
        torch, tagid: versions.
    """

    commit: str
    seed: int
    scenes: int
    ats_every: int
    epochs: int
    distribution: str
    torch: str
    tagid: str

    @classmethod
    def of(cls, seed: int, scenes: int, ats_every: int, epochs: int) -> Self:
        """The origin of a network that this code trains."""
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=False,
        )
        return cls(
            commit=done.stdout.strip() or "unknown",
            seed=seed,
            scenes=scenes,
            ats_every=ats_every,
            epochs=epochs,
            distribution=Distribution().fingerprint(),
            torch=str(torch.__version__).split("+")[0],
            tagid=__version__,
        )
