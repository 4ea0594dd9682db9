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
from tagid.imaging.types import Image
from train.dataset import METHODS, Samples
from train.detector import Contract, Detection, decode, sigmoid
from train.metrics import pick_peaks
from train.network import DetectorNetwork
from train.planes import GRID, NetworkInput
from train.targets import make_batch

HIT_M = 0.012
"""A detection this near to a reflector is a hit: a little under the first null of the point response."""
PFA = (0.1, 0.03, 0.01, 0.003)
RAW = Contract(1.0, 0.0, 1.0, 0.0, 1.0, {"1": 0.0}, {})


@dataclass(frozen=True)
class Outcome:
    """Detections of one image with what they are, and the reflectors that were missed.

    Attributes:
        detections: all that the network puts forward.
        hits: of each detection, whether it is a reflector; each reflector is hit once.
        errors_m: (h, 2) position errors of the hits.
        missed: reflectors that no detection hits.
        present: logit of there being any.
    """

    detections: list[Detection]
    hits: list[bool]
    errors_m: NDArray[np.float64]
    missed: int
    present: float


def score(detections: list[Detection], reflectors: NDArray[np.floating], present: float = 0.0) -> Outcome:
    """Pair detections, surest first, with reflectors (K, 2), m; rows of nan are none."""
    remaining = [r for r in reflectors if np.isfinite(r[0])]
    hits, errors = [], []
    for d in detections:
        gaps = [float(np.hypot(d.x_m - r[0], d.y_m - r[1])) for r in remaining]
        hit = bool(gaps) and min(gaps) <= HIT_M
        hits.append(hit)
        if hit:
            r = remaining.pop(int(np.argmin(gaps)))
            errors.append((d.x_m - r[0], d.y_m - r[1]))
    return Outcome(detections, hits, np.array(errors).reshape(-1, 2), len(remaining), present)


def seen(samples: Samples, i: int) -> NetworkInput:
    picture = samples.relative[i].astype(np.float32)
    relative = (picture[0] + 1j * picture[1]).astype(np.complex64)
    return NetworkInput(relative, 1.0, float(samples.snr_db[i]), int(samples.views[i]))


def outcomes(network: DetectorNetwork, samples: Samples, contract: Contract = RAW) -> list[Outcome]:
    results = []
    network.eval()
    with torch.no_grad():
        for start in range(0, len(samples), 64):
            which = np.arange(start, min(start + 64, len(samples)))
            cells, present = network(make_batch(samples, which).planes)
            for i, c, p in zip(which, cells.numpy(), present.numpy(), strict=True):
                decoded = decode(c, seen(samples, int(i)), contract)
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
    logits = _logit(np.array([d.probability for o in raw for d in o.detections]))
    labels = np.array([hit for o in raw for hit in o.hits], dtype=np.float64)
    slope, intercept = _logistic(logits, labels)
    there = np.array([o.missed + sum(o.hits) > 0 for o in raw], dtype=np.float64)
    if there.all():
        raise ModelError(
            f"all {len(raw)} validation images show reflectors: false alarms cannot be measured",
            "Make a larger dataset: python -m train dataset --scenes 400",
        )
    present = _logistic(np.array([o.present for o in raw]), there)
    errors = np.concatenate([o.errors_m for o in raw])
    sigmas = np.array([d.sigma_m for o in raw for d, hit in zip(o.detections, o.hits, strict=True) if hit])
    sure = np.array([d.probability for o in raw for d, hit in zip(o.detections, o.hits, strict=True) if hit])
    use = sure > 0.3
    scale = float(np.sqrt(np.mean((errors[use] ** 2).sum(axis=1) / (2 * sigmas[use] ** 2))))
    best = [max((d.probability for d in o.detections), default=0.0) for o in raw]
    empty = sigmoid(slope * _logit(np.array(best)) + intercept)[there == 0]
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
        pairs = [list(zip(o.detections, o.hits, strict=True)) for o in results]
        kept = [[hit for d, hit in pair if d.probability >= threshold] for pair in pairs]
        truths = [o.missed + sum(o.hits) for o in results]
        hits = sum(sum(k) for k in kept)
        errors = [
            error
            for o, pair in zip(results, pairs, strict=True)
            for error, d in zip(o.errors_m, [d for d, hit in pair if hit], strict=True)
            if d.probability >= threshold
        ]
        empty = [len(k) > 0 for k, t in zip(kept, truths, strict=True) if t == 0]
        said = [contract.present_slope * o.present + contract.present_intercept > 0 for o in results]
        right = [s == (t > 0) for s, t in zip(said, truths, strict=True)]
        return cls(
            len(results),
            sum(truths),
            hits / max(1, sum(truths)),
            hits / max(1, sum(len(k) for k in kept)),
            float(np.mean(empty)) if empty else float("nan"),
            1e3 * float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))) if errors else float("nan"),
            float(np.mean(right)) if right else float("nan"),
        )


def conditions(samples: Samples) -> dict[str, NDArray[np.bool_]]:
    """Named subsets, by image method, views and SNR."""
    snr, views = samples.scene_snr_db, samples.views
    subsets: dict[str, NDArray[np.bool_]] = {"all": np.ones(len(samples), dtype=bool)}
    for i, method in enumerate(METHODS):
        subsets[f"{method} images"] = samples.method == i
    for low, high in ((-3, 5), (5, 12), (12, 26)):
        subsets[f"{low} to {high} dB"] = (snr >= low) & (snr < high)
    for low, high in ((12, 18), (36, 36), (72, 360)):
        subsets[f"{low} to {high} views" if low != high else f"{low} views"] = (views >= low) & (
            views <= high
        )
    return {name: keep for name, keep in subsets.items() if keep.any()}


def local_maxima(seen_now: NetworkInput) -> list[Detection]:
    """The baseline: peaks of the magnitude, each with a number in 0..1 that grows with its height over noise.

    Peaks under half of the brightest are taken for sidelobes (7.9 dB down in a full turn).
    """
    peaks = pick_peaks(Image(seen_now.relative, GRID), 8, threshold=0.5)
    detections = []
    for x, y in peaks:
        value = seen_now.value_at(float(x), float(y))
        snr_db = seen_now.snr_db + 20 * np.log10(max(abs(value), 1e-6))
        p = 1 / (1 + np.exp(-(snr_db - 20) / 4))
        detections.append(Detection(float(x), float(y), 3e-3, float(p), 0.0, value))
    return sorted(detections, key=lambda d: -d.probability)


def maxima_figures(validation: Samples, test: Samples, pfa: float) -> Figures:
    """The baseline's figures at the threshold that gives the false-alarm rate on the validation scenes."""

    def scored(samples: Samples) -> list[Outcome]:
        indices = range(len(samples))
        return [score(local_maxima(seen(samples, i)), samples.reflectors[i]) for i in indices]

    return Figures.of(scored(test), threshold_at(scored(validation), pfa))


def threshold_at(results: list[Outcome], pfa: float) -> float:
    """The probability that a share pfa of the images without reflectors exceeds; 0.5 where there are none."""
    empty = [o for o in results if o.missed + sum(o.hits) == 0]
    best = [max((d.probability for d in o.detections), default=0.0) for o in empty]
    return float(np.quantile(best, 1 - pfa)) if best else 0.5
