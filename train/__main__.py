"""`python -m train`: the detector from nothing to a shipped model, step by step or in one command.

Every step can be killed and started again; none repeats what is there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tagid.errors import TagidError, UsageError
from train.dataset import ATS_EVERY, SCENES, Size, plans

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help=__doc__,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
Folder = Annotated[Path, typer.Option("--work", help="Folder of the dataset and checkpoints.")]
Scenes = Annotated[int, typer.Option(help="Training scenes; a tenth of it again validates.")]
MadeScenes = Annotated[int | None, typer.Option("--scenes", help="Training scenes; those of the dataset.")]
Jobs = Annotated[int, typer.Option(help="Processes.")]
AtsEvery = Annotated[int, typer.Option(help="Image every so many-th scene by ATS too; 0 for none.")]
MadeAtsEvery = Annotated[int | None, typer.Option("--ats-every", help="As in the dataset.")]
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

    def show(done: int, total: int) -> None:
        bar.update(task, completed=done, total=total)

    return show


@app.command()
def dataset(
    work: Folder = WORK, scenes: Scenes = SCENES, jobs: Jobs = 2, ats_every: AtsEvery = ATS_EVERY
) -> None:
    """Draw scenes and image them. Example: python -m train dataset --scenes 6000 --jobs 2"""
    from train.dataset import build

    Size(scenes, ats_every).remember(work)
    for plan in plans(scenes, ats_every).values():
        with _bar() as bar:
            build(work, plan, jobs, _shown(bar, f"{plan.split} images"))


@app.command()
def fit(
    work: Folder = WORK,
    scenes: MadeScenes = None,
    ats_every: MadeAtsEvery = None,
    epochs: Epochs = EPOCHS,
    seed: Seed = 0,
    jobs: Jobs = 1,
    device: Device = "cpu",
) -> None:
    """Train the network on the dataset. Example: python -m train fit --epochs 12"""
    from train.dataset import load
    from train.fit import Epoch, FitSettings
    from train.fit import fit as train_network

    console = Console(stderr=True)
    size = Size.of(work, scenes, ats_every)
    split = plans(size.scenes, size.ats_every)
    trained: list[int] = []
    with _bar() as bar:
        show = _shown(bar, "training")

        def report(epoch: Epoch) -> None:
            trained.append(epoch.number)
            console.print(
                f"epoch {epoch.number}/{epoch.epochs}: loss {epoch.training:.4f}, "
                f"validation {epoch.validation:.4f}"
            )

        train_network(
            load(work, split["train"]),
            load(work, split["validation"]),
            work / "checkpoint.pt",
            FitSettings(epochs=epochs, seed=seed, device=device),
            lambda step, steps, _: show(step, steps),
            report,
            jobs,
        )
    if not trained:
        console.print(f"nothing to train: {work / 'checkpoint.pt'} has all {epochs} epochs")


@app.command()
def evaluate(work: Folder = WORK, scenes: MadeScenes = None, ats_every: MadeAtsEvery = None) -> None:
    """Print the figures of the trained network on test scenes. Example: python -m train evaluate"""
    from train.card import figures_table, measure

    console = Console(soft_wrap=True)
    size = Size.of(work, scenes, ats_every)
    console.print(figures_table(measure(work, size.scenes, size.ats_every).figures), markup=False)


@app.command()
def export(
    work: Folder = WORK,
    scenes: MadeScenes = None,
    ats_every: MadeAtsEvery = None,
    epochs: Annotated[int | None, typer.Option(help="As trained, if not given.")] = None,
    seed: Annotated[int | None, typer.Option(help="As trained, if not given.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder; export in the work folder if not given.")] = None,
    install: Install = False,
) -> None:
    """Write the trained network as ONNX, its manifest entry and its card.

    Example: python -m train export
    Example: python -m train export --install
    """
    from train.card import measure, write_card
    from train.detector import FOLDER
    from train.export import check_better
    from train.export import export as write_model
    from train.fit import settings_of
    from train.origin import Origin

    if install and out is not None:
        raise UsageError("--install writes into the package, not into --out", "Give one of them.")
    size = Size.of(work, scenes, ats_every)
    trained = settings_of(work / "checkpoint.pt")
    measured = measure(work, size.scenes, size.ats_every)
    if install:
        check_better(measured.figures, FOLDER)
    origin = Origin.of(
        trained.seed if seed is None else seed,
        size.scenes,
        size.ats_every,
        trained.epochs if epochs is None else epochs,
    )
    contract = replace(measured.contract, training=asdict(origin))
    folder = FOLDER.resolve() if install else out or work / "export"
    folder.mkdir(parents=True, exist_ok=True)
    path = write_model(measured.network, contract, measured.figures, folder)
    card = write_card(measured, origin, path)
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
    fit(work, scenes, ats_every, epochs, seed, jobs, device)
    export(work, scenes, ats_every, epochs, seed, None, install)


def main() -> None:
    """Run the program; an error of the project ends in one message and its exit code."""
    try:
        app()
    except TagidError as error:
        Console(stderr=True).print(f"{error}\n{error.remedy}", markup=False)
        raise SystemExit(error.exit_code) from None


if __name__ == "__main__":
    main()
