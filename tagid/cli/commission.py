"""`tagid commission`: measure a rig step by step, and write its profile."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import consent, options
from tagid.cli.frame import Terminal, command
from tagid.cli.imaging import share_of
from tagid.cli.outputs import check_drawing
from tagid.config import Config, data_folder, load_config, radar_url
from tagid.constants import RIG_FILE
from tagid.errors import EXIT_FAILED, EXIT_OK, CaptureInterrupted, TagidError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.commissioning.bench import Bench, TapeChanges
    from tagid.commissioning.rows import StepReport
    from tagid.commissioning.steps import Step
    from tagid.result import Drawn


@dataclass(frozen=True)
class _TapeOptions:
    target: Annotated[
        str | None,
        typer.Option(
            help="Reference target: octahedron:40mm, corner:20cm, sphere:10cm or can:33mm.",
            show_default="octahedron:40mm",
        ),
    ] = None
    distance: Annotated[
        float | None, typer.Option(help="Antennas to the target in a straight line, metres.")
    ] = None
    tape_error: Annotated[
        float | None, typer.Option(help="Standard error of the tape measure, metres.", show_default="0.005")
    ] = None
    axis_distance: options.AxisDistance = None
    antenna_height: options.AntennaHeight = None
    antenna_separation: options.AntennaSeparation = None


@command("commission")
def commission(
    terminal: Terminal,
    tape: _TapeOptions,
    step: Annotated[
        str | None,
        typer.Option(
            help="Do or repeat this step alone: link, room, target, turning, card or result.",
            show_default="all, from the first not passed",
        ),
    ] = None,
    radar: options.RadarUrl = None,
    motion: options.MotionUrl = None,
    seconds: Annotated[
        float, typer.Option(min=1, max=600, help="How long the link is watched, seconds.")
    ] = 30.0,
    scans: Annotated[int, typer.Option(min=32, max=5000, help="Scans of room and target.")] = 200,
    page: Annotated[Path | None, typer.Option(help="Write the results as a page (.html or .pdf).")] = None,
    bundle: Annotated[
        Path | None,
        typer.Option(
            help="Do no step; write what was recorded as an archive without names and times (.zip)."
        ),
    ] = None,
    yes: consent.Yes = False,
) -> Result:
    """Measure a rig step by step, from the link to the test card, and write its profile.

    What was measured is kept: a later call goes on with the first step that did not pass.

    Example: tagid commission --axis-distance 1.0 --antenna-height 0.05 --distance 1.0
    Example: tagid commission --step target --target corner:20cm --distance 1.5 --page rig.html
    """
    from tagid.commissioning.bench import Bench
    from tagid.commissioning.bundle import write_bundle
    from tagid.commissioning.steps import STEPS, next_step, run_step, step_named
    from tagid.rig import set_aside_damaged

    names = [known.name for known in STEPS]
    if step is not None and step not in names:
        raise UsageError(f"--step is {step[:40]!r}", f"Give one of {', '.join(names)}.")
    check_drawing("--page", page, (".html", ".pdf"))
    check_drawing("--bundle", bundle, (".zip",))
    # The steps write a damaged profile again.
    damaged = set_aside_damaged(data_folder())
    aside: tuple[str, ...] = ()
    if damaged is not None:
        aside = (f"the rig profile was damaged; it is kept as {damaged.name}, and not used",)
    config = load_config({"radar.url": radar, "motion.url": motion})
    given: TapeChanges = {
        "target": tape.target,
        "target_distance_m": tape.distance,
        "axis_distance_m": tape.axis_distance,
        "antenna_height_m": tape.antenna_height,
        "antenna_separation_m": tape.antenna_separation,
        "error_m": tape.tape_error,
    }
    if bundle is not None:
        bench = Bench(config, given)
        files = write_bundle(bench, bundle)
        archive = {"bundle": str(bundle), "files": files, "page": _page(page, bench)}
        return Result("commission", archive, f"written  {bundle}")
    done: list[StepReport] = []
    bench = Bench(config, given, seconds, scans)
    first = next_step(bench) if step is None else step_named(step)
    if first is not STEPS[-1]:
        radar_url(config)
    chosen = [first] if step is not None else list(STEPS[STEPS.index(first) :])
    ended: TagidError | None = None
    try:
        for chosen_step in chosen:
            _prepare(chosen_step, config, yes, ask=step is None)
            with terminal.progress(chosen_step.name, 1.0) as advance:
                bench.progress = share_of(advance)
                done.append(run_step(chosen_step, bench))
            terminal.show(_drawn(done[-1]))
            if not done[-1].passed:
                break
    except TagidError as error:
        ended = error
    written, profile = _page(page, bench), data_folder() / RIG_FILE
    data = {
        "steps": [report.to_json() for report in done],
        "next": next_step(bench).name,
        "profile": str(profile) if profile.exists() else None,
        "page": written,
    }
    drawn = None if written is None else f"written  {written}"
    if ended is not None:
        return Result.from_error("commission", ended, data, drawn, aside)
    passed = all(report.passed for report in done)
    return Result("commission", data, drawn, exit_code=EXIT_OK if passed else EXIT_FAILED, messages=aside)


def _prepare(step: Step, config: Config, yes: bool, ask: bool) -> None:
    """Tell the person what to do first, and wait. Raises UsageError, CaptureInterrupted."""
    if step.turns:
        consent.agree_to(config["motion.url"], yes)
    if not (step.prepare and ask) or yes:
        return
    if not consent.can_ask():
        raise UsageError(
            f"{step.prepare}: there is no terminal to wait on",
            f"Do that, then run the step alone: --step {step.name}.",
        )
    if not consent.confirm(f"{step.prepare}. Ready?", default=True):
        raise CaptureInterrupted("stopped before the step; what was measured is kept")


def _page(page: Path | None, bench: Bench) -> str | None:
    if page is None:
        return None
    from tagid.commissioning.page import write_page
    from tagid.commissioning.steps import reports_by_title
    from tagid.rig import installed_profile

    write_page(page, reports_by_title(bench), installed_profile(data_folder()))
    return str(page)


def _drawn(report: StepReport) -> Drawn:
    from rich.text import Text

    styles = {"pass": "green", "note": "dim", "fail": "bold red"}
    wide = max((len(row.name) for row in report.rows), default=0)
    text = Text()
    text.append(f"{report.step}\n", "bold")
    for row in report.rows:
        text.append(f"{row.level.value:4}", styles[row.level])
        text.append(f"  {row.name:{wide}}  {'  '.join(filter(None, (row.number, row.text)))}\n")
        if row.advice and row.level != "pass":
            text.append(f"      -> {row.advice}\n", "bold")
    text.rstrip()
    return text
