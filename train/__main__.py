"""`python -m train`: the detector from nothing to a shipped model, step by step or in one command.

Every step can be killed and started again; none repeats what is there.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tagid.errors import TagidError
from train.dataset import ATS_EVERY, SCENES, Size

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help=__doc__,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
Folder = Annotated[Path, typer.Option("--work", help="Folder of the dataset and checkpoints.")]
Scenes = Annotated[int, typer.Option(help="Training scenes; a tenth of it again validates.")]
Jobs = Annotated[int, typer.Option(help="Processes.")]
AtsEvery = Annotated[int, typer.Option(help="Image every so many-th scene by ATS too; 0 for none.")]
Epochs = Annotated[int, typer.Option(help="Passes over the dataset.")]
Device = Annotated[str, typer.Option(help="Of torch: cpu, or cuda on a computer with a GPU.")]
Seed = Annotated[int, typer.Option(help="Of weights, order and symmetries.")]
Install = Annotated[
    bool, typer.Option("--install", help="Replace the shipped network, unless it is better than this one.")
]
WORK = Path("build/train")
EPOCHS = 12


def _bar() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True))


def _shown(bar: Progress, text: str) -> Callable[[int, int], None]:
    """A progress callback (done, total) that moves a bar of its own."""
    task = bar.add_task(text, total=None)
    return lambda done, total: bar.update(task, completed=done, total=total)


@app.command()
def dataset(
    work: Folder = WORK, scenes: Scenes = SCENES, jobs: Jobs = 2, ats_every: AtsEvery = ATS_EVERY
) -> None:
    """Draw scenes and image them. Example: python -m train dataset --scenes 6000 --jobs 2"""
    from train.dataset import build

    size = Size(scenes, ats_every)
    plans = size.plans()
    size.remember(work)
    for plan in plans.values():
        with _bar() as bar:
            build(work, plan, jobs, _shown(bar, f"{plan.split} images"))


@app.command()
def fit(
    work: Folder = WORK, epochs: Epochs = EPOCHS, seed: Seed = 0, jobs: Jobs = 1, device: Device = "cpu"
) -> None:
    """Train the network on the dataset. Example: python -m train fit --epochs 12"""
    from train.dataset import load
    from train.fit import FitSettings
    from train.fit import fit as train_network

    console = Console(stderr=True)
    plans, checkpoint = Size.of(work).plans(), work / "checkpoint.pt"
    trained: list[int] = []
    with _bar() as bar:

        def report(epoch: int, training: float, validation: float) -> None:
            trained.append(epoch)
            console.print(f"epoch {epoch}/{epochs}: loss {training:.4f}, validation {validation:.4f}")

        training, validation = (load(work, plans[split]) for split in ("train", "validation"))
        settings = FitSettings(epochs=epochs, seed=seed, device=device)
        train_network(training, validation, checkpoint, settings, _shown(bar, "training"), report, jobs)
    if not trained:
        console.print(f"nothing to train: {checkpoint} has all {epochs} epochs")


@app.command()
def evaluate(work: Folder = WORK) -> None:
    """Print the figures of the trained network on test scenes. Example: python -m train evaluate"""
    from train.export import figures_table, measure

    Console(soft_wrap=True).print(figures_table(measure(work).figures), markup=False)


@app.command()
def export(work: Folder = WORK, install: Install = False) -> None:
    """Write the trained network as ONNX, its manifest entry and its card into the folder export.

    Example: python -m train export
    Example: python -m train export --install
    """
    from train.detector import FOLDER
    from train.export import check_better, measure, write_card
    from train.export import export as write_model

    measured = measure(work)
    if install:
        check_better(measured.figures, FOLDER)
    folder = FOLDER.resolve() if install else work / "export"
    folder.mkdir(parents=True, exist_ok=True)
    path = write_model(measured.network, measured.contract, measured.figures, folder)
    card = write_card(measured, path)
    Console(stderr=True).print(
        f"wrote {path} ({path.stat().st_size / 1e3:.0f} kB) and {card}", soft_wrap=True
    )


@app.command(name="all")
def all_steps(
    work: Folder = WORK,
    scenes: Scenes = SCENES,
    jobs: Jobs = 2,
    ats_every: AtsEvery = ATS_EVERY,
    epochs: Epochs = EPOCHS,
    seed: Seed = 0,
    device: Device = "cpu",
    install: Install = False,
) -> None:
    """Dataset, fit and export in one run, which rebuilds the shipped model with --install.

    Example: python -m train all --install
    """
    dataset(work, scenes, jobs, ats_every)
    fit(work, epochs, seed, jobs, device)
    export(work, install)


def main() -> None:
    """Run the program; an error of the project ends in one message and its exit code."""
    try:
        app()
    except TagidError as error:
        Console(stderr=True).print(f"{error}\n{error.remedy}", markup=False)
        raise SystemExit(error.exit_code) from None


if __name__ == "__main__":
    main()
