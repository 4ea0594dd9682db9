"""`tagid identify`: name the objects of recorded scans."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.outputs import check_drawing
from tagid.errors import EXIT_BATCH, EXIT_FAILED, TagidError, UsageError, displayable
from tagid.result import Result
from tagid.secret import MotionUrl

if TYPE_CHECKING:
    from tagid.operate.turn import Answer
    from tagid.operate.workplace import Workplace
    from tagid.result import Drawn


@dataclass(frozen=True)
class _ViewOptions:
    preview: options.Preview = False
    png: options.PngFile = None
    vote: Annotated[
        bool, typer.Option("--vote", help="All files show the same object: give one joint answer.")
    ] = False
    explain: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Also show the hypotheses that competed, as bars; with --png also what they leave.",
        ),
    ] = False


@command("identify")
def identify(
    terminal: Terminal, files: options.Captures, setup: options.RecordedOptions, view: _ViewOptions
) -> Result:
    """Name the object in one or more captures.

    Example: tagid identify helmet.tagid.h5
    """
    from tagid.operate.workplace import Workplace

    if view.vote and (view.preview or view.png):
        raise UsageError("--vote does not draw an image", "Omit --preview and --png.")
    if len(files) > 1 and (view.preview or view.png):
        raise UsageError(
            f"--preview and --png draw one recording, and {len(files)} are given",
            "Omit them, or identify the files one by one.",
        )
    check_drawing("--png", view.png, (".png",), files)
    overrides = setup.settings()
    place = Workplace(overrides, setup.background)
    if view.vote:
        return vote_on(terminal, place, files, "identify", explain=view.explain)
    given = {
        name: value.public if isinstance(value, MotionUrl) else value
        for name, value in overrides.items()
        if value is not None
    }
    return _run(terminal, place, files, view, given)


def _run(
    terminal: Terminal, place: Workplace, files: list[Path], view: _ViewOptions, given: dict[str, object]
) -> Result:
    """Identify each file; a file that fails becomes a failed item; the others continue."""
    from tagid.cli import imaging
    from tagid.operate.turn import draw, draw_residuals_of, failed, read, residuals_beside

    setup = place.setup()
    answers: list[Answer] = []
    drawn: list[Drawn] = []
    written: str | None = None
    for path in files:
        answer = read(setup, path)
        if answer.error is None and (view.preview or view.png):
            try:
                with terminal.progress("image", total=1.0) as advance:
                    result = draw(answer, view.png, False, imaging.share_of(advance)).result
                written = str(view.png) if view.png else None
                if view.png and view.explain:
                    draw_residuals_of(answer.identification, residuals_beside(view.png))
                if view.preview:
                    drawn.append(imaging.in_terminal(result))
            except TagidError as error:
                answer = failed(error, answer.file)
        answers.append(answer)
        if answer.error is None:
            drawn.append(imaging.describe(answer, displayable(path.name), terminal.verbose > 0, view.explain))
    errors = [answer for answer in answers if answer.error is not None]
    code = imaging.exit_code_of([answer.identification for answer in answers])
    if code == EXIT_FAILED:
        code = errors[-1].error.exit_code if errors[-1].error else code
    if len(errors) == len(files) > 1:
        code = EXIT_BATCH
    items = [answer.to_dict() for answer in answers]
    remarks = [
        f"{displayable(path.name)}: {remark}" if len(files) > 1 else remark
        for path, answer in zip(files, answers, strict=True)
        for remark in answer.remarks
    ]
    notes = place.remember("identify", items, {"background": place.background, **given})
    return Result(
        "identify",
        {"items": items, "png": written},
        drawn or None,
        exit_code=code,
        messages=(*remarks, *notes),
        errors=tuple(problem for answer in errors if (problem := answer.identification.error)),
        completed=len(files) - len(errors),
    )


def vote_on(
    terminal: Terminal, place: Workplace, files: list[Path], command_name: str, *, explain: bool = False
) -> Result:
    """One joint answer from recordings of one object. Raises the errors of reading them."""
    from tagid.cli import imaging
    from tagid.operate.turn import read_jointly

    answer = read_jointly(place.setup(as_recorded=command_name == "scan"), files)
    items = [answer.to_dict()]
    notes = place.remember(command_name, items, {"background": place.background, "vote": len(files)})
    return Result(
        command_name,
        {"items": items, "png": None},
        _joint_text(answer, terminal.verbose > 0, explain),
        exit_code=imaging.exit_code_of([answer.identification]),
        messages=(*answer.remarks, *notes),
    )


def _joint_text(answer: Answer, verbose: bool, explain: bool) -> Drawn:
    """The joint answer as text, with one line per recording."""
    from tagid.cli import imaging
    from tagid.counting import counted
    from tagid.operate.words import headline

    lines = [f"  {alone.file}: {headline(alone.identification)}" for alone in answer.alone]
    source = f"from {counted(len(answer.alone), 'recording')}"
    return [imaging.describe(answer, source, verbose, explain), *lines]
