"""Targets of the network: cells with reflectors, ghosts and offsets, and the loss against them.

The reflector map follows the centre-point way of detection (X. Zhou, D. Wang, P. Kraehenbuehl, "Objects as
Points", 2019): a focal loss that spares the neighbours of a hit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from train.dataset import Samples
from train.detector import CELL_M, CELLS
from train.planes import NetworkInput

HIT_SIGMA = 0.7
"""Of the Gaussian around a reflector that spares neighbours in the focal loss, cells."""
GHOST_WIDTH = 1.0
"""Cells within this distance of a ghost's ring are ghost cells."""


Arrays = tuple[NDArray[np.float32], ...]


class Batch(NamedTuple):
    """Tensors of n samples: planes (n, 5, 96, 96); heat, ghost, near (n, 48, 48); offset (n, 2, 48, 48)."""

    planes: Tensor
    heat: Tensor
    ghost: Tensor
    near: Tensor
    offset: Tensor
    present: Tensor

    @classmethod
    def of(cls, arrays: Arrays, device: torch.device | str = "cpu") -> Batch:
        """Arrays in the order of the attributes on a device of torch."""
        return cls(*(torch.from_numpy(values).to(device) for values in arrays))


def symmetry(
    values: NDArray[Any], points: NDArray[np.floating], which: int
) -> tuple[NDArray[Any], NDArray[np.floating]]:
    """One of the eight turns and mirrors of the square for planes (..., y, x) and points (..., 2 or 3)."""
    points = points.copy()
    if which & 4:
        values = values[..., ::-1]
        points[..., 0] *= -1
    for _ in range(which & 3):
        # np.rot90 turns the picture with y downwards clockwise seen with y upwards: (x, y) -> (y, -x).
        values = np.rot90(values, 1, axes=(-2, -1))
        points[..., 0], points[..., 1] = points[..., 1].copy(), -points[..., 0]
    return values, points


def batch_arrays(
    samples: Samples, which: NDArray[np.intp], symmetries: NDArray[np.intp] | None = None
) -> Arrays:
    """The samples of some indexes as `Batch` has them, each turned by one of eight symmetries if given."""
    planes, rows = [], []
    for n, i in enumerate(which):
        turn = 0 if symmetries is None else int(symmetries[n])
        seen = network_input(samples, i)
        relative, reflectors = symmetry(seen.relative, samples.reflectors[i], turn)
        _, ghosts = symmetry(seen.relative, samples.ghosts[i], turn)
        whole = relative.copy(order="K")  # of a turned view, magnitudes differ in the last digit
        planes.append(replace(seen, relative=whole).planes())
        rows.append(cell_targets(reflectors, ghosts))
    present = np.isfinite(samples.reflectors[which][:, 0, 0])
    parts = (np.stack(planes), *map(np.stack, zip(*rows, strict=True)), present)
    return tuple(np.ascontiguousarray(part, dtype=np.float32) for part in parts)


def network_input(samples: Samples, i: int) -> NetworkInput:
    """One sample as the network sees it."""
    real, imaginary = samples.relative[i].astype(np.float32)
    relative = (real + 1j * imaginary).astype(np.complex64)
    return NetworkInput(relative, 1.0, float(samples.snr_db[i]), int(samples.views[i]))


def cell_targets(
    reflectors: NDArray[np.floating], ghosts: NDArray[np.floating]
) -> tuple[NDArray[np.float32], ...]:
    """heat, ghost, near (48, 48) and offset (2, 48, 48) for reflectors (K, 2) and ghosts (G, 3), m."""
    at = np.arange(CELLS)
    x, y = np.meshgrid(at, at)
    heat = np.zeros((CELLS, CELLS), dtype=np.float32)
    ghost, near = heat.copy(), heat.copy()
    offset = np.zeros((2, CELLS, CELLS), dtype=np.float32)
    closest = np.full((CELLS, CELLS), np.inf)
    for point in reflectors[np.isfinite(reflectors[:, 0])]:
        u, v = point / CELL_M + CELLS / 2 - 0.5
        i, j = round(float(u)), round(float(v))
        distance = np.hypot(x - u, y - v)
        heat = np.maximum(heat, np.exp(-(distance**2) / (2 * HIT_SIGMA**2)).astype(np.float32) * 0.99)
        if 0 <= i < CELLS and 0 <= j < CELLS:
            heat[j, i] = 1
        mine = (distance < 1.6) & (distance < closest)
        closest = np.where(mine, distance, closest)
        near[mine] = 1
        offset[0][mine], offset[1][mine] = (u - x)[mine], (v - y)[mine]
    for gx, gy, radius in ghosts[np.isfinite(ghosts[:, 0])] / CELL_M:
        distance = np.abs(np.hypot(x - (gx + CELLS / 2 - 0.5), y - (gy + CELLS / 2 - 0.5)) - radius)
        ghost[(distance < GHOST_WIDTH) & (near == 0)] = 1
    return heat, ghost, near, offset


def loss(cells: Tensor, present: Tensor, batch: Batch) -> Tensor:
    """Focal loss of the reflectors + ghosts + offset's negative log likelihood + presence."""
    logit = cells[:, 0]
    log_yes, log_no = functional.logsigmoid(logit), functional.logsigmoid(-logit)
    hit = batch.heat == 1
    count = hit.sum().clamp(min=1)
    p = torch.sigmoid(logit)
    focal = -torch.where(hit, (1 - p) ** 2 * log_yes, (1 - batch.heat) ** 4 * p**2 * log_no).sum() / count
    ghosts = functional.binary_cross_entropy_with_logits(cells[:, 1], batch.ghost)
    log_sigma = cells[:, 4].clamp(-4, 1)
    squared = ((cells[:, 2:4] - batch.offset) ** 2).sum(dim=1)
    likelihood = 0.5 * squared * torch.exp(-2 * log_sigma) + 2 * log_sigma
    offset = (likelihood * batch.near).sum() / batch.near.sum().clamp(min=1)
    there = functional.binary_cross_entropy_with_logits(present, batch.present)
    return focal + 2 * ghosts + 0.3 * offset + 0.3 * there
