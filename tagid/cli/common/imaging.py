"""How `scan`, `identify` and `reconstruct` show an image and an answer in the terminal."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tagid.counting import counted
from tagid.errors import EXIT_BATCH, EXIT_FAILED, EXIT_OK, EXIT_UNCERTAIN

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tagid.pipeline.answer import Identification
    from tagid.pipeline.reconstruct import Reconstruction


def learned(result: Reconstruction) -> dict[str, Any]:
    """Findings about the recording, for the JSON document."""
    settings = result.image.settings
    names = (
        "axis_distance_m", "focus", "held_out", "prior", "prior_trials", "priors_not_tried", "pulse",
        "calibration", "warnings",
    )  # fmt: skip
    return {name: settings[name] for name in names if name in settings}


def share_of(advance: Callable[[float, str], None]) -> Callable[[float, float, str], None]:
    """The progress of a computation, (done, total, remark), as the share of a progress line."""
    return lambda done, total, remark: advance(done / max(total, 1), remark)


def in_terminal(result: Reconstruction) -> RenderableType:
    """The image as text, in colour if the terminal supports it and NO_COLOR is not set."""
    from rich.console import Console

    from tagid.report.preview import colour_wanted, preview

    image = result.image
    colour = colour_wanted(Console())
    return preview(image.values, image.grid.extent, colour=colour, centre_m=image.centre_m)


def describe(answer: Identification, name: str) -> RenderableType:
    """The answer as text: one bold line, then the details."""
    from rich.console import Group
    from rich.text import Text

    from tagid.operate.words import bound_words, degrees, headline, hypothesis_words, nearest_words

    colours = {"identified": "bold green", "failed": "bold red"}
    style = colours.get(answer.status, "bold yellow")
    first = Text.assemble((headline(answer).upper(), style), f"   {answer.label}   {name}")
    lines = [first]
    reading = answer.reading
    if answer.error:
        lines.append(Text(f"  {answer.error.message} {answer.error.remedy}"))
    if reading:
        if reading.reason:
            lines.append(Text(f"  why: {reading.reason}"))
            if answer.status == "unknown":
                lines.append(Text(f"  nearest layout: {nearest_words(answer)}"))
            for cause in answer.causes:
                lines.append(Text(f"  likely cause: {cause.text}", "bold"))
                lines.append(Text(f"  what to do: {cause.remedy}"))
            if all(cause.code != reading.code.value for cause in answer.causes):
                lines.append(Text(f"  {'otherwise' if answer.causes else 'what to do'}: {reading.advice}"))
        if words := hypothesis_words(reading):
            lines.append(Text(f"  read as: {words}"))
        if reading.note:
            lines.append(Text(f"  note: {reading.note}"))
        if reading.bound is not None:
            lines.append(Text(f"  {bound_words(reading.bound)}"))
        elif reading.status == "identified":
            lines.append(Text("  no bound on false accept: answers of this kind are not calibrated"))
        if reading.layout:
            x, y = (value * 1e3 for value in reading.centre_m)
            lines.append(
                Text(
                    f"  rotated {degrees(reading.rotation_deg)} deg, centre ({x:.1f}, {y:.1f}) mm, "
                    f"margin {reading.margin:.2f}, {counted(len(reading.reflectors), 'reflector')}"
                )
            )
    return Group(*lines)


def exit_code_of(answers: list[Identification]) -> int:
    """0 all identified, 3 some unknown/ambiguous/no tag, 1 the only item failed, 5 some items failed."""
    if any(answer.status == "failed" for answer in answers):
        return EXIT_FAILED if len(answers) == 1 else EXIT_BATCH
    return EXIT_OK if all(answer.status == "identified" for answer in answers) else EXIT_UNCERTAIN
