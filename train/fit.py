"""Trains the network: deterministic from a seed, and after a kill it continues where the last epoch ended.

The state of an epoch is written whole or not at all, with the random generator's, so that a run that was cut
gives the same weights as one that was not.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LRScheduler, OneCycleLR

from tagid import processes
from tagid.errors import StorageError
from tagid.files import read_bytes, write_bytes
from train.dataset import Samples
from train.network import DetectorNetwork
from train.targets import Arrays, Batch, batch_arrays, loss

Parts = dict[str, nn.Module | Optimizer | LRScheduler]
Draw = tuple[NDArray[np.intp], NDArray[np.intp]]
"""A batch that is to be made: the samples' indexes and the symmetry of each, 0 to 7."""
RATE, DECAY = 4e-3, 1e-4
"""Peak of the one-cycle learning rate of Adam, and weight decay."""


@dataclass(frozen=True)
class FitSettings:
    """How the network is trained.

    Attributes:
        epochs, batch: passes over the data, samples a step.
        seed: of weights, order and symmetries.
        threads: of torch; sums depend on it in the last digits.
        device: of torch, "cpu" or "cuda"; sums depend on it in the last digits.
    """

    epochs: int = 10
    batch: int = 32
    seed: int = 0
    threads: int = 2
    device: str = "cpu"


def fit(
    training: Samples,
    validation: Samples,
    checkpoint: Path,
    settings: FitSettings,
    progress: Callable[[int, int], None] = lambda step, steps: None,
    report: Callable[[int, float, float], None] = lambda epoch, training, validation: None,
    jobs: int = 1,
) -> DetectorNetwork:
    """Train, or finish training.

    Args:
        training, validation: samples.
        checkpoint: file with the state after the last whole epoch.
        settings: see there; those of the checkpoint must agree.
        progress: called with (step, steps).
        report: called after every epoch with its number and the mean losses.
        jobs: processes that prepare batches; the weights do not depend on them.

    Raises StorageError if the checkpoint is damaged or of other settings.
    """
    s = settings
    torch.set_num_threads(s.threads)
    torch.manual_seed(s.seed)
    # On a GPU some gradients have no deterministic kernel: the weights then differ in the last digits.
    torch.use_deterministic_algorithms(True, warn_only=s.device != "cpu")
    network = DetectorNetwork()
    network.to(s.device)
    optimiser = AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    size = min(s.batch, len(training))
    count = len(training) // size
    schedule = OneCycleLR(optimiser, RATE, total_steps=max(1, s.epochs * count), pct_start=0.2)
    parts: Parts = {"network": network, "optimiser": optimiser, "schedule": schedule}
    identity = {**asdict(s), "samples": len(training)}
    with _batches(training, jobs) as batches:
        for epoch in range(_resume(checkpoint, parts, identity), s.epochs):
            rng = np.random.default_rng((s.seed, epoch))
            order = rng.permutation(len(training))[: count * size].reshape(count, size)
            network.train()
            total = 0.0
            draws = [(which, rng.integers(0, 8, size)) for which in order]
            for step, arrays in enumerate(batches(draws), epoch * count + 1):
                batch = Batch.of(arrays, s.device)
                cells, present = network(batch.planes)
                value = loss(cells, present, batch)
                optimiser.zero_grad()
                value.backward()
                nn.utils.clip_grad_norm_(network.parameters(), 5.0)
                optimiser.step()
                schedule.step()
                total += float(value.detach())
                progress(step, s.epochs * count)
            _save(checkpoint, parts, identity, epoch + 1)
            report(epoch + 1, total / count, mean_loss(network, validation))
    network.to("cpu")
    network.eval()
    return network


_samples: Samples | None = None


def _receive(samples: Samples) -> None:
    global _samples  # sent once to each process, not with every batch
    _samples = samples
    torch.set_num_threads(1)


def _arrays(draw: Draw) -> Arrays:
    assert _samples is not None
    return batch_arrays(_samples, *draw)


@contextmanager
def _batches(training: Samples, jobs: int) -> Iterator[Callable[[list[Draw]], Iterator[Arrays]]]:
    """A function from draws to their batches in order, prepared ahead by so many processes."""
    if jobs < 2:
        yield lambda draws: (batch_arrays(training, *draw) for draw in draws)
        return
    with processes.spawn_context().Pool(jobs, _receive, (training,)) as pool:
        yield lambda draws: pool.imap(_arrays, draws)


def few_at_a_time(samples: Samples) -> Iterator[NDArray[np.intp]]:
    """The indexes of all samples, as many at once as fit into memory."""
    yield from np.split(np.arange(len(samples)), range(64, len(samples), 64))


def mean_loss(network: DetectorNetwork, samples: Samples) -> float:
    """Loss of a network that is not training."""
    network.eval()
    device = next(network.parameters()).device
    total = 0.0
    with torch.no_grad():
        for which in few_at_a_time(samples):
            batch = Batch.of(batch_arrays(samples, which), device)
            cells, present = network(batch.planes)
            total += float(loss(cells, present, batch)) * len(which)
    return total / len(samples)


def _save(path: Path, parts: Parts, identity: dict[str, object], epoch: int) -> None:
    buffer = io.BytesIO()
    torch.save({"epoch": epoch, "own": identity, **{k: v.state_dict() for k, v in parts.items()}}, buffer)
    write_bytes(path, buffer.getvalue())


def _resume(path: Path, parts: Parts, identity: dict[str, object]) -> int:
    if not path.exists():
        return 0
    with _state(path, "Remove it and start again.") as state:
        if state["own"] != identity:
            raise StorageError(f"{path}: is of another training", "Choose another folder, or remove it.")
        for name, part in parts.items():
            part.load_state_dict(state[name])
        return int(state["epoch"])


@contextmanager
def _state(path: Path, remedy: str = "Train again.") -> Iterator[Any]:
    """What a checkpoint holds. Raises StorageError where it does not hold what is asked of it."""
    try:
        yield torch.load(io.BytesIO(read_bytes(path)), map_location="cpu", weights_only=True)
    except (KeyError, RuntimeError, ValueError, EOFError) as error:
        raise StorageError(f"{path}: damaged checkpoint: {error}", remedy) from error


def settings_of(path: Path) -> FitSettings:
    """How the network of a checkpoint was trained. Raises StorageError."""
    with _state(path) as state:
        return FitSettings(**{name: state["own"][name] for name in FitSettings.__dataclass_fields__})


def load_network(path: Path) -> DetectorNetwork:
    """The network of a checkpoint, ready to be used. Raises StorageError."""
    network = DetectorNetwork()
    with _state(path) as state:
        network.load_state_dict(state["network"])
    network.eval()
    return network
