"""How `scan`, `identify` and `reconstruct` show an image and an answer in the terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tagid.counting import counted
from tagid.errors import EXIT_BATCH, EXIT_FAILED, EXIT_OK, EXIT_UNCERTAIN

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from tagid.operate.turn import Answer
    from tagid.pipeline.answer import Identification
    from tagid.pipeline.reconstruct import Reconstruction
    from tagid.reading.reading import Reading
    from tagid.result import Drawn

_BAR = 20
"""Longest bar, nats."""


def learned(result: Reconstruction) -> dict[str, Any]:
    """Findings about the recording, for the JSON document."""
    settings = result.image.settings
    names = (
        "axis_distance_m", "focus", "held_out", "prior", "pulse",
        "calibration", "warnings",
    )  # fmt: skip
    return {name: settings[name] for name in names if name in settings}


def share_of(advance: Callable[[float, str], None]) -> Callable[[float, float, str], None]:
    """The progress of a computation, (done, total, remark), as the share of a progress line."""
    return lambda done, total, remark: advance(done / max(total, 1), remark)


def in_terminal(result: Reconstruction) -> Drawn:
    """The image as text, in colour if the terminal supports it and NO_COLOR is not set."""
    from rich.console import Console

    from tagid.report.preview import colour_wanted, preview

    image = result.image
    colour = colour_wanted(Console())
    return preview(image.values, image.grid.extent, colour=colour, centre_m=image.centre_m)


class Screen:
    """Draws frames with `draw(state, title, size, colour)`, and counts those of the live screen."""

    def __init__(
        self, console: Console, title: str, state: Callable[[], Any], draw: Callable[..., RenderableType]
    ) -> None:
        self._console, self._title, self._state, self._draw = console, title, state, draw
        self._frames = 0
        self._first_s = self._last_s = 0.0

    def frame(self) -> RenderableType:
        from tagid.report.preview import colour_wanted

        size = (self._console.size.width, self._console.size.height)
        return self._draw(self._state(), self._title, size, colour_wanted(self._console))

    def counted_frame(self) -> RenderableType:
        self._last_s = time.monotonic()
        self._first_s = self._first_s or self._last_s
        self._frames += 1
        return self.frame()

    def facts(self) -> dict[str, Any]:
        """How many frames were counted, as JSON values."""
        spent = self._last_s - self._first_s
        rate = (self._frames - 1) / spent if spent > 0 else None
        return {"frames": self._frames, "frames_per_second": rate}


def describe(answer: Answer, name: str, verbose: bool, explain: bool = False) -> Drawn:
    """The answer as text: the name, how far to trust it or what to do, and all else only where asked for.

    Args:
        answer: not failed.
        name: shown beside it, e.g. of the file.
        verbose: also show how it was read.
        explain: also show the hypotheses that competed.
    """
    from rich.text import Text

    from tagid.operate import words

    identification = answer.identification
    reading = identification.reading
    style = "bold green" if identification.status == "identified" else "bold yellow"
    beside = "".join(f"   {part}" for part in (identification.label, name) if part)
    lines: list[Drawn] = [Text.assemble((words.name_of(identification).upper(), style), beside)]
    if reading is None:
        return lines
    if identification.status == "identified":
        lines.append(f"  {words.trust_words(identification)}")
    elif identification.causes:
        for cause in identification.causes:
            lines.append(Text(f"  likely cause: {cause.text}", "bold"))
            lines.append(f"  what to do: {cause.remedy}")
            if cause.settings and answer.file:
                lines.append(f"  then: `tagid identify {_again(answer.file, cause.settings)}`")
    else:
        lines += [f"  why: {reading.reason}", f"  what to do: {identification.what_to_do()}"]
    if (
        identification.status == "identified"
        and reading.bound
        and (part := words.coverage_words(identification.coverage))
    ):
        lines.append(Text(f"  caution: {part}", "yellow"))
    if reading.note:
        lines.append(Text(f"  caution: {reading.note}", "yellow"))
    if truth := words.truth_words(answer.truth):
        lines.append(f"  truth: {truth}")
    details = (f"  {line}" for line in _details(identification) if verbose)
    return [*lines, *details, *(_competing(reading) if explain else ())]


def _competing(reading: Reading) -> Iterator[Drawn]:
    """The hypotheses, and as bars how far they are behind the likeliest, with a mark where a name begins."""
    from rich.padding import Padding

    from tagid.report.table import Table

    needed = round(reading.needed) if isfinite(reading.needed) else None
    mark = "" if needed is None else f" (a name needs {reading.needed:.1f}: the |)"
    yield f"  behind the likeliest, nats of log evidence{mark}:"
    table = Table()
    table.pad_edge, table.collapse_padding = False, True
    # Nothing wins over what is hardly likelier.
    for row in sorted(reading.hypotheses, key=lambda row: abs(row.log_evidence)):
        behind = abs(row.log_evidence)
        bar = list("#" * round(behind) if behind <= _BAR else "#" * _BAR + "+")
        if needed is not None and needed < len(bar):
            bar[needed] = "|"
        table.add_row(f"{behind:7.1f}", "".join(bar), f"{row.words}, {row.residual_words}")
    yield Padding(table, (0, 0, 0, 2))


def _again(file: str, settings: dict[str, Any]) -> str:
    """The arguments that read a recording with other settings."""
    import shlex

    from tagid.cli.wording import OPTIONS

    options = (f"{OPTIONS[name]} {shlex.quote(str(value))}" for name, value in settings.items())
    return " ".join((shlex.quote(file), *options))


def _details(answer: Identification) -> Iterator[str]:
    """How an answer was read, one line each."""
    from tagid.operate import words

    reading = answer.reading
    if reading is None:
        return
    if answer.status == "unknown":
        yield f"nearest layout: {words.nearest_words(answer)}"
    if answer.causes:
        yield f"why: {reading.reason}"
        if all(cause.code != reading.code.value for cause in answer.causes):
            yield f"otherwise: {answer.what_to_do()}"
    if hypothesis := words.hypothesis_words(reading):
        yield f"read as: {hypothesis}"
    if reading.bound is not None:
        yield words.bound_words(reading.bound)
    if reading.layout:
        x, y = (value * 1e3 for value in reading.centre_m)
        yield (
            f"rotated {words.degrees(reading.rotation_deg)} deg, centre ({x:.1f}, {y:.1f}) mm, "
            f"score {reading.score:.2f}, margin {reading.margin:.2f}, "
            f"{counted(len(reading.reflectors), 'reflector')}"
        )


def saved(files: dict[str, str | None]) -> str:
    """The files of a recording in one line: the capture, then the others by the ends of their names.

    >>> saved({"capture": "a/b.tagid.h5", "png": "a/b.png", "image": None})
    'a/b.tagid.h5, b.png'
    """
    first, *others = (path for path in files.values() if path)
    return ", ".join((first, *(Path(path).name for path in others)))


def exit_code_of(answers: list[Identification]) -> int:
    """0 all identified, 3 some unknown/ambiguous/no tag, 1 the only item failed, 5 some items failed."""
    if any(answer.status == "failed" for answer in answers):
        return EXIT_FAILED if len(answers) == 1 else EXIT_BATCH
    return EXIT_OK if all(answer.status == "identified" for answer in answers) else EXIT_UNCERTAIN
