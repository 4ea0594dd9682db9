"""What a network is worth on scenes it was not trained on, and the numbers that make its outputs honest.

Calibration and thresholds come from the validation scenes, every figure that is shown from the test scenes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from tagid.errors import ModelError
from train.dataset import METHODS, Samples
from train.detector import Contract, Detection, decode, sigmoid
from train.fit import few_at_a_time
from train.network import DetectorNetwork
from train.targets import Batch, batch_arrays, network_input

HIT_M = 0.012
"""A detection this near to a reflector is a hit: a little under the first null of the point response."""
PFA = (0.1, 0.03, 0.01, 0.003)
RAW = Contract(1.0, 0.0, 1.0, 0.0, 1.0, {"1": 0.0}, {})


@dataclass(frozen=True, eq=False)
class Outcome:
    """Detections of one image with what they are, and the reflectors that were missed.

    Attributes:
        detections: all that the network puts forward.
        errors_m: (d, 2) position error of each; nan for one that is no reflector. Each reflector is hit once.
        missed: reflectors that no detection hits.
        present: logit of there being any.
    """

    detections: list[Detection]
    errors_m: NDArray[np.float64]
    missed: int
    present: float

    @property
    def hits(self) -> NDArray[np.bool_]:
        """Of each detection, whether it is a reflector."""
        return np.isfinite(self.errors_m[:, 0])

    @property
    def reflectors(self) -> int:
        """How many there are."""
        return self.missed + int(self.hits.sum())

    @property
    def probability(self) -> NDArray[np.float64]:
        """Of each detection."""
        return np.array([d.probability for d in self.detections], dtype=np.float64)


def score(detections: list[Detection], reflectors: NDArray[np.floating], present: float = 0.0) -> Outcome:
    """Pair detections, surest first, with reflectors (K, 2), m; rows of nan are none."""
    remaining = [r for r in reflectors if np.isfinite(r[0])]
    errors = np.full((len(detections), 2), np.nan)
    for i, d in enumerate(detections):
        gaps = [float(np.hypot(d.x_m - r[0], d.y_m - r[1])) for r in remaining]
        if gaps and min(gaps) <= HIT_M:
            r = remaining.pop(int(np.argmin(gaps)))
            errors[i] = d.x_m - r[0], d.y_m - r[1]
    return Outcome(detections, errors, len(remaining), present)


def outcomes(network: DetectorNetwork, samples: Samples, contract: Contract = RAW) -> list[Outcome]:
    """What the network makes of every sample."""
    results = []
    network.eval()
    with torch.no_grad():
        for which in few_at_a_time(samples):
            cells, present = network(Batch.of(batch_arrays(samples, which)).planes)
            for i, c, p in zip(which, cells.numpy(), present.numpy(), strict=True):
                decoded = decode(c, network_input(samples, i), contract)
                results.append(score(decoded, samples.reflectors[i], float(p)))
    return results


def _logistic(logit: NDArray[np.float64], label: NDArray[np.float64]) -> tuple[float, float]:
    """Slope and intercept with sigmoid(slope * logit + intercept) the rate of labels (J. Platt, 1999)."""

    def cost(x: NDArray[np.float64]) -> float:
        z = x[0] * logit + x[1]
        return float(np.mean(np.logaddexp(0, z) - label * z))

    x = minimize(cost, np.array([1.0, 0.0]), method="Nelder-Mead").x
    return float(x[0]), float(x[1])


def _logit(p: NDArray[np.float64]) -> NDArray[np.float64]:
    q = np.clip(p, 1e-9, 1 - 1e-9)
    return np.asarray(np.log(q / (1 - q)))


def calibrate(network: DetectorNetwork, validation: Samples) -> Contract:
    """The contract whose probabilities, sigmas and thresholds hold on the validation scenes.

    Its `training` is empty. Raises ModelError where no validation scene is without a reflector.
    """
    raw = outcomes(network, validation)
    hits = np.concatenate([o.hits for o in raw])
    probability = np.concatenate([o.probability for o in raw])
    slope, intercept = _logistic(_logit(probability), hits.astype(np.float64))
    there = np.array([o.reflectors > 0 for o in raw], dtype=np.float64)
    if there.all():
        raise ModelError(
            f"all {len(raw)} validation images show reflectors: false alarms cannot be measured",
            "Make a larger dataset: python -m train dataset --scenes 400",
        )
    present = _logistic(np.array([o.present for o in raw]), there)
    use = hits & (probability > 0.3)
    errors = np.concatenate([o.errors_m for o in raw])[use]
    sigmas = np.array([d.sigma_m for o in raw for d in o.detections])[use]
    scale = float(np.sqrt(np.mean((errors**2).sum(axis=1) / (2 * sigmas**2))))
    best = np.array([o.probability.max(initial=0.0) for o in raw])
    empty = sigmoid(slope * _logit(best) + intercept)[there == 0]
    thresholds = {f"{pfa:g}": float(np.quantile(empty, 1 - pfa)) for pfa in PFA}
    return Contract(slope, intercept, present[0], present[1], scale, thresholds, {})


@dataclass(frozen=True)
class Figures:
    """Figures of a set of outcomes at one threshold.

    Attributes:
        images, reflectors: how many.
        recall: share of reflectors found. precision: share of detections that are reflectors.
        false_images: share of images without reflectors in which one is seen; nan where there are none.
        rms_mm: root mean square distance of the hits, mm.
        presence: share of images whose presence is classified correctly at 0.5.
    """

    images: int
    reflectors: int
    recall: float
    precision: float
    false_images: float
    rms_mm: float
    presence: float

    @classmethod
    def of(cls, results: list[Outcome], threshold: float, contract: Contract = RAW) -> Figures:
        """Those of some outcomes."""
        sure = [o.probability >= threshold for o in results]
        truths = np.array([o.reflectors for o in results])
        hits = sum(int(o.hits[yes].sum()) for o, yes in zip(results, sure, strict=True))
        squared = np.concatenate(
            [(o.errors_m**2).sum(axis=1)[yes] for o, yes in zip(results, sure, strict=True)]
        )
        squared = squared[np.isfinite(squared)]
        empty = np.array([yes.any() for yes in sure])[truths == 0]
        logit = contract.present_slope * np.array([o.present for o in results]) + contract.present_intercept
        return cls(
            len(results),
            int(truths.sum()),
            hits / max(1, int(truths.sum())),
            hits / max(1, sum(int(yes.sum()) for yes in sure)),
            float(empty.mean()) if len(empty) else float("nan"),
            1e3 * float(np.sqrt(squared.mean())) if len(squared) else float("nan"),
            float(np.mean((logit > 0) == (truths > 0))),
        )


def conditions(samples: Samples) -> dict[str, NDArray[np.bool_]]:
    """Named subsets, by image method, views and SNR."""
    snr, views = samples.scene_snr_db, samples.views
    subsets = {"all": np.ones(len(samples), dtype=bool)}
    subsets |= {f"{method} images": samples.method == i for i, method in enumerate(METHODS)}
    for low, high in ((-3, 5), (5, 12), (12, 26)):
        subsets[f"{low} to {high} dB"] = (snr >= low) & (snr < high)
    for low, high, name in ((12, 18, "12 to 18"), (36, 36, "36"), (72, 360, "72 to 360")):
        subsets[f"{name} views"] = (views >= low) & (views <= high)
    return {name: keep for name, keep in subsets.items() if keep.any()}
