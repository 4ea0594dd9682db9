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
from torch.optim.lr_scheduler import LRScheduler

from tagid import processes
from tagid.errors import StorageError
from tagid.files import read_bytes, write_bytes
from train.dataset import Samples
from train.network import DetectorNetwork
from train.targets import Batch, loss, make_batch

Parts = dict[str, nn.Module | Optimizer | LRScheduler]


@dataclass(frozen=True)
class FitSettings:
    """How the network is trained.

    Attributes:
        epochs, batch: passes over the data, samples a step.
        rate: peak of the one-cycle learning rate of Adam.
        decay: weight decay.
        seed: of weights, order and symmetries.
        threads: of torch; sums depend on it in the last digits.
        device: of torch, "cpu" or "cuda"; sums depend on it in the last digits.
        hidden: planes of the input that are shown as zeros, to measure what they are worth.
    """

    epochs: int = 10
    batch: int = 32
    rate: float = 4e-3
    decay: float = 1e-4
    seed: int = 0
    threads: int = 2
    device: str = "cpu"
    hidden: tuple[int, ...] = ()


@dataclass(frozen=True)
class Epoch:
    """What an epoch came to: mean losses, and how many epochs there are."""

    number: int
    epochs: int
    training: float
    validation: float


def fit(
    training: Samples,
    validation: Samples,
    checkpoint: Path,
    settings: FitSettings | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    report: Callable[[Epoch], None] | None = None,
    jobs: int = 1,
) -> DetectorNetwork:
    """Train, or finish training.

    Args:
        training, validation: samples.
        checkpoint: file with the state after the last whole epoch.
        settings: see there; those of the checkpoint must agree.
        progress: called with (step, steps, loss).
        report: called after every epoch.
        jobs: processes that prepare batches; the weights do not depend on them.

    Raises StorageError if the checkpoint is damaged or of other settings.
    """
    s = settings or FitSettings()
    torch.set_num_threads(s.threads)
    torch.manual_seed(s.seed)
    # On a GPU some gradients have no deterministic kernel: the weights then differ in the last digits.
    torch.use_deterministic_algorithms(True, warn_only=s.device != "cpu")
    network = DetectorNetwork()
    network.to(s.device)
    optimiser = AdamW(network.parameters(), lr=s.rate, weight_decay=s.decay)
    size = min(s.batch, len(training))
    steps = s.epochs * (len(training) // size)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, s.rate, total_steps=max(1, steps), pct_start=0.2
    )
    parts: Parts = {"network": network, "optimiser": optimiser, "schedule": schedule}
    identity = {**asdict(s), "samples": len(training)}
    first = _resume(checkpoint, parts, identity)
    with _batches(training, jobs) as batches:
        for epoch in range(first, s.epochs):
            rng = np.random.default_rng((s.seed, epoch))
            order = rng.permutation(len(training))
            network.train()
            total = 0.0
            count = len(training) // size
            draws = [
                Draw(order[step * size : (step + 1) * size], rng.integers(0, 8, size))
                for step in range(count)
            ]
            for step, made in enumerate(batches(draws)):
                batch = made.to(s.device)
                batch.planes[:, list(s.hidden)] = 0
                cells, present = network(batch.planes)
                value = loss(cells, present, batch)
                optimiser.zero_grad()
                value.backward()
                nn.utils.clip_grad_norm_(network.parameters(), 5.0)
                optimiser.step()
                schedule.step()
                total += float(value.detach())
                if progress:
                    progress(epoch * count + step + 1, steps, float(value.detach()))
            _save(checkpoint, parts, identity, epoch + 1)
            if report:
                report(
                    Epoch(
                        epoch + 1, s.epochs, total / max(1, count), mean_loss(network, validation, s.hidden)
                    )
                )
    network.to("cpu")
    network.eval()
    return network


@dataclass(frozen=True, eq=False)
class Draw:
    """A batch that is to be made: the samples' indexes and the symmetry of each, 0 to 7."""

    which: NDArray[np.intp]
    symmetries: NDArray[np.intp]


_samples: Samples | None = None


def _receive(samples: Samples) -> None:
    global _samples  # sent once to each process, not with every batch
    _samples = samples
    torch.set_num_threads(1)


def _arrays(draw: Draw) -> tuple[NDArray[np.float32], ...]:
    assert _samples is not None
    return make_batch(_samples, draw.which, draw.symmetries).arrays()


@contextmanager
def _batches(training: Samples, jobs: int) -> Iterator[Callable[[list[Draw]], Iterator[Batch]]]:
    """A function from draws to their batches in order, prepared ahead by so many processes."""
    if jobs < 2:
        yield lambda draws: (make_batch(training, d.which, d.symmetries) for d in draws)
        return
    with processes.spawn_context().Pool(jobs, _receive, (training,)) as pool:
        yield lambda draws: map(Batch.of, pool.imap(_arrays, draws))


def mean_loss(network: DetectorNetwork, samples: Samples, hidden: tuple[int, ...]) -> float:
    """Loss of a network that is not training."""
    network.eval()
    device = next(network.parameters()).device
    total = 0.0
    with torch.no_grad():
        for start in range(0, len(samples), 64):
            which = np.arange(start, min(start + 64, len(samples)))
            made = make_batch(samples, which).to(device)
            made.planes[:, list(hidden)] = 0
            cells, present = network(made.planes)
            total += float(loss(cells, present, made)) * len(which)
    return total / max(1, len(samples))


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
