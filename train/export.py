"""The trained network as the ONNX file that the package ships, with all it promises inside it.

The calibration, the thresholds with the false-alarm rates that they give, and what it was trained on travel
in the file's metadata, so that model and promise cannot be parted.
"""

from __future__ import annotations

import subprocess
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tagid import __version__
from tagid.models_store import FOLDER, OPSET, Tensor, entry_of, write_entry
from tagid.tags.network.detector import CELLS, CONTRACT_KEY, MODEL, Contract
from tagid.tags.network.planes import GRID, PLANES
from train.network import CHANNELS, DetectorNetwork


def training_record(seed: int, scenes: int, ats_every: int, epochs: int) -> dict[str, Any]:
    """What made the model: commit, seed, dataset, versions."""
    from train.distributions import Distribution

    done = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    return {
        "commit": done.stdout.strip() or "unknown",
        "seed": seed,
        "scenes": scenes,
        "ats_every": ats_every,
        "epochs": epochs,
        "distribution": Distribution().fingerprint(),
        "torch": str(torch.__version__).split("+")[0],
        "tagid": __version__,
    }


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
    model.ClearField("metadata_props")
    model.graph.ClearField("metadata_props")
    del model.graph.value_info[:]
    for node in model.graph.node:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
    entry = model.metadata_props.add()
    entry.key, entry.value = CONTRACT_KEY, contract.to_text()
    model.producer_name, model.producer_version = "tagid", __version__
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString(deterministic=True))


def export(
    network: DetectorNetwork, contract: Contract, figures: dict[str, Any], folder: Path = FOLDER
) -> Path:
    """Write the model and its entry in the manifest; the file's path.

    Raises:
        ModelError: the exported graph is not what `Detector` takes. StorageError: it cannot be written.
    """
    content = onnx_bytes(network, contract)
    planes = Tensor("float32", (1, PLANES, GRID.pixels, GRID.pixels))
    outputs = {"cells": Tensor("float32", (1, CHANNELS, CELLS, CELLS)), "present": Tensor("float32", (1,))}
    facts = {"purpose": "reflectors in an image of a turn", "source": "train/", "figures": figures}
    write_entry(entry_of(MODEL, content, {"planes": planes}, outputs, facts), content, folder)
    return folder / f"{MODEL}.onnx"


def plain(value: Any) -> Any:
    """Figures as JSON values, floats rounded to four digits."""
    numbers = asdict(value) if hasattr(value, "__dataclass_fields__") else dict(value)
    rounded = {k: round(v, 4) if isinstance(v, float) else v for k, v in numbers.items()}
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in rounded.items()}
