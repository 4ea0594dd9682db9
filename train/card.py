"""Figures of a trained network under every condition, as a table and as the model card that is shipped.

The card is written by the same run that measured, so that it cannot tell of another model.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tagid.files import write_bytes
from train.dataset import METHODS, load, plans
from train.detector import PFA, Contract
from train.evaluate import Figures, calibrate, conditions, maxima_figures, outcomes
from train.fit import load_network
from train.network import DetectorNetwork
from train.origin import Origin

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
is there, however weak its side or far below the noise; a hit is within 12 mm. "Local maxima" is the baseline:
peaks of the magnitude, judged by their height over the noise, at a threshold of the same false-alarm rate.

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
        contract: its calibration, from the validation scenes; `training` is empty.
        figures: on the test scenes, by condition.
    """

    network: DetectorNetwork
    contract: Contract
    figures: dict[str, Figures]


def measure(work: Path, scenes: int, ats_every: int) -> Measured:
    """Calibrate the trained network and measure it.

    Args:
        work: folder of the dataset and the checkpoint.
        scenes, ats_every: size of the dataset, as in `train.dataset.DatasetPlan`.

    Raises StorageError if the dataset or the checkpoint is missing.
    """
    split = plans(scenes, ats_every)
    network = load_network(work / "checkpoint.pt")
    validation = load(work, split["validation"])
    contract = calibrate(network, validation)
    test = load(work, split["test"])
    results = outcomes(network, test, contract)
    threshold = contract.threshold(PFA)
    figures = {
        name: Figures.of([o for o, yes in zip(results, keep, strict=True) if yes], threshold, contract)
        for name, keep in conditions(test).items()
    }
    for i, method in enumerate(METHODS):
        held, seen_now = validation.part(validation.method == i), test.part(test.method == i)
        if len(held) and len(seen_now):
            figures[f"{method}, local maxima"] = maxima_figures(held, seen_now, PFA)
    return Measured(network, contract, figures)


def figures_table(figures: dict[str, Figures]) -> str:
    """Markdown."""
    rows = [HEADER, "|---|---|---|---|---|---|---|---|"]
    for name, f in figures.items():
        rows.append(
            f"| {name} | {f.images} | {f.reflectors} | {100 * f.recall:.1f} % | {100 * f.precision:.1f} % | "
            f"{100 * f.false_images:.1f} % | {f.rms_mm:.1f} mm | {100 * f.presence:.1f} % |"
        )
    return "\n".join(rows)


def write_card(measured: Measured, origin: Origin, model: Path) -> Path:
    """Write the card of a model next to its file; returns its path."""
    parameters = sum(p.numel() for p in DetectorNetwork().parameters())
    text = CARD.format(
        scenes=origin.scenes,
        ats_every=origin.ats_every,
        commit=origin.commit,
        seed=origin.seed,
        parameters=f"{parameters:,}",
        size=round(model.stat().st_size / 1e3),
        thresholds=", ".join(
            f"{value:.2f} for {100 * float(rate):g} %" for rate, value in measured.contract.thresholds.items()
        ),
        table=figures_table(measured.figures),
    )
    path = model.with_name("README.md")
    write_bytes(path, text.encode())
    return path
