"""What a trained network is worth, and the network as an ONNX file with all it promises inside it.

The calibration, the thresholds with the false-alarm rates that they give, and what it was trained on travel
in the file's metadata, so that model and promise cannot be parted. The card beside it is written by the same
run that measured, so that it cannot tell of another model.
"""

from __future__ import annotations

import subprocess
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tagid._version import __version__
from tagid.errors import ModelError
from tagid.files import write_bytes
from tagid.models_store import OPSET, Tensor, manifest
from train.dataset import Size, load
from train.detector import CELLS, CONTRACT_KEY, FOLDER, MODEL, PFA, Contract
from train.distributions import Distribution
from train.evaluate import Figures, calibrate, conditions, outcomes
from train.fit import FitSettings, load_network, settings_of
from train.model_files import entry_of, strip, write_entry
from train.network import CHANNELS, DetectorNetwork
from train.planes import GRID, PLANES

CARD = """# Reflector detector

Finds the small octahedral reflectors in a 0.5 m square image (96 x 96 pixels) of one turn: a heat map, offset
and its sigma, a calibrated probability, and whether a place shows a ghost (interaction image of near
reflectors, arc of a shell off its axis, handle, rim, box edge). For research: the program does not use
it, as names are read in the scans themselves (`tagid/reading/`).

- Data: simulated scenes only, drawn as `train/distributions.py` declares: {scenes} scenes imaged by
  backprojection, every {ats_every}th by ATS too; commit {commit},
  seed {seed}. No real tagged object has been recorded yet.
- Network: {parameters} parameters, ONNX, {size} kB; rebuilt by `python -m train all --install`.
- Thresholds (probability to ask for a false detection in that share of images without reflectors,
  calibrated on the validation scenes): {thresholds}.

Test scenes, at the threshold for a false detection in 1 % of empty images. Recall counts every reflector that
is there, however weak its side or far below the noise; a hit is within 12 mm.

{table}

Where it fails: below 5 dB at 12 or 18 views most of what it misses lies in the noise; reflectors nearer than
3 cm were not trained on and merge; a handle as bright as a reflector to every side is one to it; objects
beyond 0.2 m from the axis are outside its image. Positions carry the error of the axis distance that the
autofocus leaves.
"""

HEADER = "| condition | images | reflectors | recall | precision | false in empty | rms | presence told |"


@dataclass(frozen=True, eq=False)
class Measured:
    """A trained network with what it is worth.

    Attributes:
        network: trained.
        contract: its calibration, from the validation scenes, with what made it.
        figures: on the test scenes, by condition.
    """

    network: DetectorNetwork
    contract: Contract
    figures: dict[str, Figures]


def measure(work: Path) -> Measured:
    """Calibrate and measure the trained network of a folder with its dataset and checkpoint.

    Raises StorageError if the dataset or the checkpoint is missing.
    """
    size, checkpoint = Size.of(work), work / "checkpoint.pt"
    network, plans = load_network(checkpoint), size.plans()
    contract = calibrate(network, load(work, plans["validation"]))
    test = load(work, plans["test"])
    results = outcomes(network, test, contract)
    threshold = contract.threshold(PFA)
    figures = {
        name: Figures.of([o for o, yes in zip(results, keep, strict=True) if yes], threshold, contract)
        for name, keep in conditions(test).items()
    }
    return Measured(network, replace(contract, training=origin(settings_of(checkpoint), size)), figures)


def origin(settings: FitSettings, size: Size) -> dict[str, Any]:
    """What made a network: it is stored in the model's file; the commit is "unknown" outside a checkout."""
    words = ["git", "rev-parse", "HEAD"]
    done = subprocess.run(words, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    return {
        "commit": done.stdout.strip() or "unknown",
        "seed": settings.seed,
        "epochs": settings.epochs,
        **asdict(size),
        "distribution": Distribution().fingerprint(),
        "torch": str(torch.__version__).split("+")[0],
        "tagid": __version__,
    }


def figures_table(figures: dict[str, Figures]) -> str:
    """Markdown."""
    rows = [HEADER, "|---|---|---|---|---|---|---|---|"]
    for name, f in figures.items():
        rows.append(
            f"| {name} | {f.images} | {f.reflectors} | {100 * f.recall:.1f} % | {100 * f.precision:.1f} % | "
            f"{100 * f.false_images:.1f} % | {f.rms_mm:.1f} mm | {100 * f.presence:.1f} % |"
        )
    return "\n".join(rows)


def write_card(measured: Measured, model: Path) -> Path:
    """Write the card of a model next to its file; returns its path."""
    thresholds = measured.contract.thresholds.items()
    text = CARD.format(
        **measured.contract.training,
        parameters=f"{sum(p.numel() for p in measured.network.parameters()):,}",
        size=round(model.stat().st_size / 1e3),
        thresholds=", ".join(f"{value:.2f} for {100 * float(rate):g} %" for rate, value in thresholds),
        table=figures_table(measured.figures),
    )
    path = model.with_name("README.md")
    write_bytes(path, text.encode())
    return path


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
