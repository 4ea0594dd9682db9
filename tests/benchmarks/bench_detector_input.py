"""What the detector's network should be shown: magnitude, complex image or both; with the loss by method.

Run `python tests/benchmarks/bench_detector_input.py WORK`, where WORK holds a dataset of `python -m train
dataset`. The same network is trained on the same scenes for the same epochs, with planes of its input hidden;
the figure is the loss on the validation scenes, in nats a sample (lower is better). `--scenes` and `--epochs`
make it short: the order matters, not how low the loss gets.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

# train/ is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from train.dataset import load
from train.fit import FitSettings, fit, mean_loss
from train.images import METHODS
from train.planes import NORMALISATION
from train.plans import plans

INPUTS = {
    "magnitude": ("real", "imaginary"),
    "complex": ("magnitude",),
    "complex and magnitude": (),
    "complex and magnitude, without SNR and views": ("snr", "views"),
}
"""Input -> planes that are hidden."""


def main() -> None:
    """Parse the command line, train each input and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path, help="folder of the dataset")
    parser.add_argument("--scenes", type=int, default=6000, help="of the dataset")
    parser.add_argument("--take", type=int, default=1500, help="samples to train on")
    parser.add_argument("--epochs", type=int, default=4)
    options = parser.parse_args()
    names = list(NORMALISATION["planes"])
    made = plans(options.scenes)
    training = load(options.work, made["train"])
    validation = load(options.work, made["validation"])
    training = training.part(slice(options.take))
    print("| input | loss | " + " | ".join(f"loss, {m}" for m in METHODS) + " |")
    print("|---|---|" + "---|" * len(METHODS))
    for label, planes in INPUTS.items():
        hidden = tuple(names.index(plane) for plane in planes)
        settings = FitSettings(epochs=options.epochs, hidden=hidden)
        with tempfile.TemporaryDirectory() as folder:
            network = fit(training, validation, Path(folder) / "checkpoint.pt", settings)
        parts = [validation.part(validation.method == i) for i in range(len(METHODS))]
        losses = [mean_loss(network, part, hidden) for part in (validation, *parts)]
        print(f"| {label} | " + " | ".join(f"{value:.3f}" for value in losses) + " |", flush=True)


if __name__ == "__main__":
    main()
