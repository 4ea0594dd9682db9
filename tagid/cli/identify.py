"""`tagid identify`: name the objects of recorded scans."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.common import options
from tagid.cli.common.frame import Terminal, command
from tagid.cli.common.outputs import check_drawing
from tagid.config import Config, load_config
from tagid.errors import EXIT_BATCH, EXIT_FAILED, TagidError, UsageError, displayable
from tagid.result import Result, Status
from tagid.secret import MotionUrl

if TYPE_CHECKING:
    from tagid.pipeline.answer import Identification


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "identify")
    def identify(
        terminal: Terminal,
        files: options.Captures,
        motion: options.MotionUrl = None,
        axis_distance: options.AxisDistance = None,
        antenna_height: options.AntennaHeight = None,
        antenna_separation: options.AntennaSeparation = None,
        background: options.Background = "mean",
        preview: options.Preview = False,
        png: options.PngFile = None,
        vote: Annotated[
            bool,
            typer.Option("--vote", help="All files show the same object: give one joint answer."),
        ] = False,
    ) -> Result:
        """Name the object in one or more captures.

        Example: tagid identify helmet.tagid.h5
        """
        if vote:
            if preview or png:
                raise UsageError("--vote does not draw an image", "Omit --preview and --png.")
            overrides = {
                "motion.url": motion,
                "motion.axis_distance_m": axis_distance,
                "motion.antenna_height_m": antenna_height,
                "motion.antenna_separation_m": antenna_separation,
            }
            return vote_on(files, load_config(overrides), background, "identify")
        if len(files) > 1 and (preview or png):
            raise UsageError(
                f"--preview and --png draw one recording, and {len(files)} are given",
                "Omit them, or identify the files one by one.",
            )
        return run(
            terminal,
            files,
            {
                "motion.url": motion,
                "motion.axis_distance_m": axis_distance,
                "motion.antenna_height_m": antenna_height,
                "motion.antenna_separation_m": antenna_separation,
            },
            View(background, preview, png),
        )


@dataclass(frozen=True)
class View:
    """Background subtraction and drawing options.

    Attributes:
        background: "mean", "median", "reference" or "none".
        preview: whether to draw the image in the terminal.
        png: file for the image; None for none.
    """

    background: str
    preview: bool
    png: Path | None


def run(terminal: Terminal, files: list[Path], overrides: dict[str, object], view: View) -> Result:
    """Identify each file; a file that fails becomes a failed item; the others continue."""
    from rich.console import Group, RenderableType

    from tagid.cli.common import imaging
    from tagid.pipeline.diagnosis import recording_remarks, with_causes
    from tagid.pipeline.identify import identify
    from tagid.pipeline.load import LoadSettings, intake_remarks, load_capture
    from tagid.pipeline.prepared import PreparedCapture

    check_drawing("--png", view.png, (".png",), files)
    config = load_config(overrides)
    registry = imaging.open_registry()
    known = registry.contents()
    answers: list[Identification] = []
    items: list[dict[str, object]] = []
    drawn: list[RenderableType] = []
    errors: list[dict[str, str]] = []
    remarks: list[str] = []
    written: str | None = None
    settings = imaging.settings_from(config, view.background)
    loading = LoadSettings.of(config, view.background)
    for path in files:
        try:
            prepared = PreparedCapture(load_capture(path, loading), settings)
            answer = identify(
                prepared, known.layouts, registry_version=known.version, signatures=known.signatures
            )
            answer = with_causes(answer, prepared, known.layouts)
            prefix = f"{displayable(path.name)}: " if len(files) > 1 else ""
            given = prepared.given
            remarks += [prefix + remark for remark in (*intake_remarks(given), *recording_remarks(given))]
            if view.preview or view.png:
                result = imaging.image_with_progress(terminal, prepared)
                if view.png:
                    imaging.draw(result, answer, view.png)
                    written = str(view.png)
                if view.preview:
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
    notes = imaging.remember("identify", items, {"background": view.background, **_given(overrides)})
    data = {"items": items, "png": written}
    return Result(
        "identify", data, Group(*drawn) if drawn else None, status, code, (*remarks, *notes), tuple(errors)
    )


def vote_on(files: list[Path], config: Config, background: str, command_name: str) -> Result:
    """One joint answer from recordings of one object. Raises the errors of reading them."""
    from tagid.cli.common import imaging
    from tagid.cli.common.voting import joint_item, joint_text
    from tagid.pipeline.identify import identify_together
    from tagid.pipeline.load import LoadSettings, load_capture

    registry = imaging.open_registry()
    loading = LoadSettings.of(config, background, as_recorded=command_name == "scan")
    captures = [load_capture(path, loading) for path in files]
    settings = imaging.settings_from(config, background)
    joint, alone = identify_together(captures, registry.layouts(), settings, registry.version)
    names = [displayable(str(path)) for path in files]
    items = [joint_item(joint, names, alone)]
    notes = imaging.remember(command_name, items, {"background": background, "vote": len(files)})
    code = imaging.exit_code_of([joint])
    human = joint_text(joint, names, alone)
    return Result(command_name, {"items": items, "png": None}, human, exit_code=code, messages=notes)


def _given(overrides: dict[str, object]) -> dict[str, object]:
    return {
        name: value.public if isinstance(value, MotionUrl) else value
        for name, value in overrides.items()
        if value is not None
    }


def _named(path: Path, message: str) -> str:
    name = displayable(str(path))
    return message if name in message else f"{name}: {message}"
