"""`tagid identify`: name the objects of recorded scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.config import Config, load_config
from tagid.errors import EXIT_BATCH, EXIT_FAILED, TagidError, UsageError, displayable
from tagid.result import Result, Status

if TYPE_CHECKING:
    from tagid.identification import Identification


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "identify")
    def identify(
        terminal: Terminal,
        files: options.Captures,
        motion: options.MotionUrl = None,
        axis_distance: options.AxisDistance = None,
        antenna_height: options.AntennaHeight = None,
        background: options.Background = "mean",
        preview: options.Preview = False,
        png: options.PngFile = None,
        vote: Annotated[
            bool,
            typer.Option("--vote", help="All files are of one object: give one answer from all of them."),
        ] = False,
    ) -> Result:
        """Name the object in one or more recorded scans.

        Example: tagid identify helmet.tagid.h5
        """
        if vote:
            if preview or png:
                raise UsageError("--vote draws no image", "Leave --preview and --png out.")
            overrides = {
                "motion.url": motion,
                "motion.axis_distance_m": axis_distance,
                "motion.antenna_height_m": antenna_height,
            }
            return vote_on(files, load_config(overrides), background, "identify")
        return run(
            terminal,
            files,
            {
                "motion.url": motion,
                "motion.axis_distance_m": axis_distance,
                "motion.antenna_height_m": antenna_height,
            },
            (background, preview, png),
        )


def run(
    terminal: Terminal,
    files: list[Path],
    overrides: dict[str, object],
    view: tuple[str, bool, Path | None],
) -> Result:
    """Identify each file; a file that fails is one failed item and stops nothing."""
    from rich.console import Group, RenderableType

    from tagid.cli import imaging
    from tagid.defaults import complete, motion_of, without_reference
    from tagid.pipeline import identify, prepare
    from tagid.storage.importers import read_any

    background, preview, png = view
    config = load_config(overrides)
    registry = imaging.open_registry()
    known = registry.contents()
    answers: list[Identification] = []
    items: list[dict[str, object]] = []
    drawn: list[RenderableType] = []
    errors: list[dict[str, str]] = []
    settings = imaging.settings_from(config, background)
    for path in files:
        try:
            capture = complete(read_any(path, config["radar.cable_delay_ps"]), config)
            capture = without_reference(capture, config, background)
            capture = prepare(capture, motion_of(config, capture))
            answer = identify(capture, known.layouts, settings, known.version, known.signatures)
            if (preview or png) and len(files) == 1:
                result = imaging.image_with_progress(terminal, capture, settings)
                if png:
                    imaging.draw(result, answer, png)
                if preview:
                    drawn.append(imaging.in_terminal(result))
        except TagidError as error:
            answer = imaging.failed(None, error)
            errors.append(
                {"code": error.code, "message": _named(path, error.message), "remedy": error.remedy}
            )
            exit_code = error.exit_code
        answers.append(answer)
        items.append({"file": displayable(str(path)), **answer.to_dict()})
        if answer.status != "failed":
            drawn.append(imaging.describe(answer, displayable(path.name)))
    code = imaging.exit_code_of(answers)
    if code == EXIT_FAILED:
        code = exit_code
    status: Status = "success" if not errors else "partial" if len(errors) < len(items) else "error"
    if status == "error" and len(files) > 1:
        code = EXIT_BATCH
    notes = imaging.remember("identify", items, {"background": background, **_given(overrides)})
    data = {"items": items, "png": str(png) if png else None}
    return Result("identify", data, Group(*drawn) if drawn else None, status, code, notes, tuple(errors))


def vote_on(files: list[Path], config: Config, background: str, command_name: str) -> Result:
    """One answer from files that are recordings of one object. Raises what reading any of them raises."""
    from tagid.cli import imaging
    from tagid.cli.voting import joint_item, joint_text
    from tagid.defaults import complete, motion_of, without_reference
    from tagid.pipeline import identify_together, prepare
    from tagid.storage.importers import read_any

    registry = imaging.open_registry()
    captures = []
    for path in files:
        capture = complete(read_any(path, config["radar.cable_delay_ps"]), config)
        capture = without_reference(capture, config, background)
        known = command_name == "scan" and capture.angles_rad is not None
        captures.append(prepare(capture, None if known else motion_of(config, capture)))
    settings = imaging.settings_from(config, background)
    joint, alone = identify_together(captures, registry.layouts(), settings, registry.version)
    names = [displayable(str(path)) for path in files]
    items = [joint_item(joint, names, alone)]
    notes = imaging.remember(command_name, items, {"background": background, "vote": len(files)})
    code = imaging.exit_code_of([joint])
    human = joint_text(joint, names, alone)
    return Result(command_name, {"items": items, "png": None}, human, exit_code=code, messages=notes)


def _given(overrides: dict[str, object]) -> dict[str, object]:
    return {name: value for name, value in overrides.items() if value is not None}


def _named(path: Path, message: str) -> str:
    name = displayable(str(path))
    return message if name in message else f"{name}: {message}"
