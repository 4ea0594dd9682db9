"""The trained network as the ONNX file that the package ships, with all it promises inside it.

The calibration, the thresholds with the false-alarm rates that they give, and what it was trained on travel
in the file's metadata, so that model and promise cannot be parted.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from tagid.errors import ModelError
from tagid.models_store import OPSET, Tensor, manifest
from train.detector import CELLS, CONTRACT_KEY, FOLDER, MODEL, PFA, Contract
from train.evaluate import Figures
from train.model_files import entry_of, strip, write_entry
from train.network import CHANNELS, DetectorNetwork
from train.planes import GRID, PLANES


def onnx_bytes(network: DetectorNetwork, contract: Contract) -> bytes:
    """The network as ONNX with the contract in metadata_props; batch size 1."""
    import onnx

    example = torch.zeros(1, PLANES, GRID.pixels, GRID.pixels)
    with warnings.catch_warnings():
        # The exporter warns of its own deprecated calls.
        warnings.simplefilter("ignore")
        exported = torch.onnx.export(
            network.eval(),
            (example,),
            dynamo=True,
            opset_version=OPSET,
            input_names=["planes"],
            output_names=["cells", "present"],
            verbose=False,
        )
    model = exported.model_proto
    strip(model)
    entry = model.metadata_props.add()
    entry.key, entry.value = CONTRACT_KEY, contract.to_text()
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def export(
    network: DetectorNetwork, contract: Contract, figures: Mapping[str, Figures], folder: Path = FOLDER
) -> Path:
    """Write the model and its entry in the manifest; the file's path.

    Args:
        contract: its calibration, with what made it.
        figures: by condition, for the manifest.
        folder: of the models.

    Raises:
        ModelError: the exported graph is not what `Detector` takes. StorageError: it cannot be written.
    """
    content = onnx_bytes(network, contract)
    planes = Tensor("float32", (1, PLANES, GRID.pixels, GRID.pixels))
    outputs = {"cells": Tensor("float32", (1, CHANNELS, CELLS, CELLS)), "present": Tensor("float32", (1,))}
    shown = {name: _rounded(figure) for name, figure in figures.items()}
    facts = {"purpose": "reflectors in an image of a turn", "source": "train/", "figures": shown}
    write_entry(entry_of(MODEL, content, {"planes": planes}, outputs, facts), content, folder)
    return folder / f"{MODEL}.onnx"


def check_better(figures: Mapping[str, Figures], folder: Path = FOLDER) -> None:
    """Raise ModelError for a network that is worse than the present one, or measured on fewer images."""
    present = manifest(folder)[MODEL].facts["figures"]["all"]
    new = figures["all"]
    better = new.recall >= present["recall"] and new.false_images <= max(present["false_images"], PFA)
    if better and new.images >= present["images"]:
        return
    raise ModelError(
        f"not installed: recall {100 * new.recall:.1f} % with {100 * new.false_images:.1f} % false in empty "
        f"on {new.images} images; the shipped network has {100 * present['recall']:.1f} % with "
        f"{100 * present['false_images']:.1f} % on {present['images']}",
        "Train on more scenes or for more epochs; without --install it is written into the work folder.",
    )


def _rounded(figures: Figures) -> dict[str, float | None]:
    """Figures as JSON values: floats to four digits, None for nan."""
    rounded = {k: round(v, 4) if isinstance(v, float) else v for k, v in asdict(figures).items()}
    return {k: v if np.isfinite(v) else None for k, v in rounded.items()}
