"""Reflectors in an image, found by a network: where, how surely, and what is a ghost.

It knows no layout, so it serves objects that nobody enrolled, and tells interaction images, shell arcs and
handles from reflectors where a test for point echoes alone cannot.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import exp, hypot
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from tagid.errors import ModelError
from tagid.models_store import Model, open_model
from train.planes import GRID, NORMALISATION, PLANES, NetworkInput

MODEL = "reflector_detector"
FOLDER = Path(__file__).resolve().parent.parent / "models" / "detector"
CONTRACT_KEY = "tagid.contract"
SCHEMA = 1
CELLS = GRID.pixels // 2
CELL_M = GRID.extent / CELLS
SEPARATION_M = 0.02
"""Two detections nearer than this are one reflector: the paper's octahedra are 40 mm tip to tip."""
_MOST = 16
PFA = 0.01
"""The false-alarm rate at whose threshold detections and figures are given."""


@dataclass(frozen=True)
class Detection:
    """A reflector that the network sees.

    Attributes:
        x_m, y_m: position in the object's plane, m.
        sigma_m: standard deviation of each coordinate, m.
        probability: of being a reflector, calibrated on scenes not trained on.
        ghost: probability that the place shows something else that echoes.
        amplitude: complex value of the image there, in the image's units.
    """

    x_m: float
    y_m: float
    sigma_m: float
    probability: float
    ghost: float
    amplitude: complex


@dataclass(frozen=True)
class Detections:
    """Answer of the network for one image.

    Attributes:
        present: probability that there is any reflector.
        detections: those above the threshold, surest first.
        threshold: required probability.
    """

    present: float
    detections: tuple[Detection, ...]
    threshold: float


@dataclass(frozen=True)
class Contract:
    """The contract in the model's file (metadata_props, key `tagid.contract`).

    Attributes:
        slope, intercept: calibrated logit = slope * logit + intercept.
        present_slope, present_intercept: the same of the presence.
        sigma_scale: factor on the network's sigma that makes it the error's.
        thresholds: probability to ask for a false detection in a share `pfa` of images without reflectors,
            by pfa as text.
        training: commit, seed, dataset; for the record.
    """

    slope: float
    intercept: float
    present_slope: float
    present_intercept: float
    sigma_scale: float
    thresholds: dict[str, float]
    training: dict[str, Any]

    def threshold(self, pfa: float) -> float:
        """Probability to ask for that false-alarm rate: of those measured, the nearest that keeps to it.

        0 for a rate of 1; the strictest measured for a rate under all of them.
        """
        if pfa >= 1:
            return 0.0
        measured = sorted((float(rate), value) for rate, value in self.thresholds.items())
        fitting = [value for rate, value in measured if rate <= pfa * (1 + 1e-9)]
        return fitting[-1] if fitting else measured[0][1]

    def to_text(self) -> str:
        """JSON for the model's file."""
        grid = {"extent_m": GRID.extent, "pixels": GRID.pixels}
        fixed = {"kind": "reflector-detector", "schema": SCHEMA, "grid": grid, "planes": PLANES}
        fixed["normalisation"] = NORMALISATION
        return json.dumps({**fixed, **vars(self)}, sort_keys=True)

    @classmethod
    def from_text(cls, text: str, where: str) -> Contract:
        """Read and check the JSON. Raises ModelError naming the given and the required value."""
        try:
            raw = json.loads(text)
            said = (raw["kind"], raw["schema"], raw["grid"]["extent_m"], raw["grid"]["pixels"], raw["planes"])
            needed = ("reflector-detector", SCHEMA, GRID.extent, GRID.pixels, PLANES)
            if said != needed:
                raise ModelError(
                    f"{where}: its contract says {said}, this program needs {needed}",
                    "Use the model that came with this version, or train one with `python -m train`.",
                )
            # Files from before this was written say nothing of it, and mean the same.
            if (scaled := raw.get("normalisation", NORMALISATION)) != NORMALISATION:
                raise ModelError(
                    f"{where}: its contract normalises by {scaled}, this program by {NORMALISATION}",
                    "Use the model that came with this version, or train one with `python -m train`.",
                )
            contract = cls(**{name: raw[name] for name in cls.__dataclass_fields__})
            numbers = [contract.slope, contract.intercept, contract.present_slope]
            numbers += [contract.present_intercept, contract.sigma_scale, *contract.thresholds.values()]
            if not contract.thresholds or not np.isfinite(np.array(numbers, dtype=np.float64)).all():
                raise ValueError("numbers are missing or not finite")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ModelError(
                f"{where}: its contract cannot be read: {error}", "Use the model that came with this version."
            ) from error
        return contract


def sigmoid(logit: NDArray[np.floating] | float) -> NDArray[np.float64]:
    """The probability of a logit."""
    return np.asarray(1 / (1 + np.exp(-np.clip(np.asarray(logit, dtype=np.float64), -60, 60))))


def decode(cells: NDArray[np.float32], seen: NetworkInput, contract: Contract) -> list[Detection]:
    """All detections in the network's cells (5, 48, 48), surest first, none nearer than `SEPARATION_M`."""
    logits = cells[0]
    rows, columns = np.nonzero(logits >= maximum_filter(logits, 3))
    order = np.argsort(-logits[rows, columns])[: 4 * _MOST]
    detections: list[Detection] = []
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        score, ghost, dx, dy, log_sigma = cells[:, row, column].tolist()
        x = (column + min(max(dx, -1.0), 1.0) - CELLS / 2 + 0.5) * CELL_M
        y = (row + min(max(dy, -1.0), 1.0) - CELLS / 2 + 0.5) * CELL_M
        if any(hypot(x - d.x_m, y - d.y_m) < SEPARATION_M for d in detections):
            continue
        logit = contract.slope * score + contract.intercept
        detections.append(
            Detection(
                x,
                y,
                contract.sigma_scale * CELL_M * exp(min(max(log_sigma, -4.0), 1.0)),
                float(sigmoid(logit)),
                float(sigmoid(ghost)),
                seen.value_at(x, y) * seen.peak,
            )
        )
        if len(detections) == _MOST:
            break
    return detections


class Detector:
    """The network with its contract, as read from the file."""

    def __init__(self, model: Model) -> None:
        """Of an opened model. Raises ModelError if its contract is another one."""
        self._model = model
        self.contract = Contract.from_text(model.metadata.get(CONTRACT_KEY, ""), f"model {model.entry.name}")

    @classmethod
    def shipped(cls) -> Detector:
        """The one that came with the package. Raises ModelError or StorageError as `open_model` does."""
        return cls(open_model(MODEL, folder=FOLDER))

    def detect(self, seen: NetworkInput) -> Detections:
        """Reflectors of an image, at the threshold for one in a hundred images without any."""
        out = self._model.run({"planes": seen.planes()[None]})
        threshold = self.contract.threshold(PFA)
        every = decode(np.asarray(out["cells"])[0], seen, self.contract)
        logit = self.contract.present_slope * float(out["present"][0]) + self.contract.present_intercept
        detections = tuple(d for d in every if d.probability >= threshold)
        return Detections(float(sigmoid(logit)), detections, threshold)
