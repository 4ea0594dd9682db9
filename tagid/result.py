"""What every command returns, and the only place that turns it into text.

Scripts read the JSON envelope, people read the drawn result; both come from one value. Names and texts come
from files and devices, so control characters are escaped here, in all that is written for people.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from tagid.errors import EXIT_OK, TagidError, visible

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult

    Drawn = RenderableType | Sequence["Drawn"]
    """Anything rich can draw, or several below each other; a string is plain text, without markup."""

RESULT_VERSION = 1
"""Version of the JSON envelope; it changes only when a field changes its meaning or goes."""

Status = Literal["success", "partial", "error"]
_NAMED = re.compile(r"`([a-z][a-z0-9_]*(?:\.[a-z0-9_]+)?)(?:=([^`\s]+))?`")
_PROSE = frozenset(
    (
        "advice",
        "cause",
        "error_message",
        "message",
        "note",
        "problem",
        "reason",
        "remark",
        "remarks",
        "remedy",
        "steps",
        "text",
        "warnings",
    )
)
"""Fields of documents that hold sentences of this program."""


NO_NAMES = ("no_tag", "unknown", "ambiguous", "failed")
"""Answers that name nothing."""


@dataclass(frozen=True)
class Problem:
    """An error as documents state it.

    Attributes:
        code: stable, for programs.
        message: what went wrong and where.
        remedy: what to do next; may be empty.
    """

    code: str
    message: str
    remedy: str = ""

    @classmethod
    def of(cls, error: TagidError) -> Problem:
        """The item of an error."""
        return cls(error.code, error.message, error.remedy)

    @classmethod
    def from_json(cls, item: dict[str, Any]) -> Problem:
        """The item of a document. Raises KeyError."""
        return cls(item["code"], item["message"], item["remedy"])

    def to_json(self) -> dict[str, str]:
        """Plain JSON values: {code, message, remedy}."""
        return {"code": self.code, "message": self.message, "remedy": self.remedy}


def reworded(text: str, words: Callable[[str, str], str | None]) -> str:
    """Text with the settings that it names as a front end offers them.

    Args:
        text: names settings and arguments in backticks, as `name` or `name=value`.
        words: for a name and its value, "" without one; None leaves them as they are.
    """
    return _NAMED.sub(lambda match: words(match[1], match[2] or "") or match[0], text)


def reworded_document(value: Any, words: Callable[[str], str], prose: bool = False) -> Any:
    """A JSON document, or a part that is `prose`, with its sentences in other words; names and files stay."""
    if isinstance(value, dict):
        return {key: reworded_document(item, words, key in _PROSE) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [reworded_document(item, words, prose) for item in value]
    return words(value) if prose and isinstance(value, str) else value


@dataclass(frozen=True)
class Result:
    """Outcome of one command.

    Attributes:
        command: name of the command, e.g. "scan".
        data: plain JSON values, the machine's half.
        human: the person's half, see `Drawn`; nothing is drawn where it is None.
        exit_code: exit code of the process.
        messages: remarks that are not errors, one sentence each.
        errors: what failed.
        completed: parts of the job that were completed in spite of the errors.
        csv: the same as a table, for commands that offer it.
    """

    command: str
    data: dict[str, Any] = field(default_factory=dict)
    human: Drawn | None = None
    _: KW_ONLY
    exit_code: int = EXIT_OK
    messages: tuple[str, ...] = ()
    errors: tuple[Problem, ...] = ()
    completed: int = 0
    csv: str = ""

    @classmethod
    def from_error(
        cls,
        command: str,
        error: TagidError,
        data: dict[str, Any] | None = None,
        human: Drawn | None = None,
        messages: tuple[str, ...] = (),
    ) -> Result:
        """The outcome of a command that ended with an error, with what it has to show nevertheless."""
        return cls(
            command,
            data or {},
            human,
            exit_code=error.exit_code,
            messages=messages,
            errors=(Problem.of(error),),
        )

    @property
    def status(self) -> Status:
        """ "success" without errors, "partial" if something was completed in spite of them, else "error"."""
        if not self.errors:
            return "success"
        return "partial" if self.completed else "error"

    def envelope(self) -> dict[str, Any]:
        """The JSON document of the contract, as plain values."""
        return {
            "tagid_result_version": RESULT_VERSION,
            "command": self.command,
            "status": self.status,
            "exit_code": self.exit_code,
            "data": _plain(self.data),
            "messages": list(self.messages),
            "errors": [problem.to_json() for problem in self.errors],
        }


def _plain(value: Any) -> Any:
    """JSON has no NaN and knows no numpy: numbers that are not finite become null, arrays lists."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    return str(value)


def render(result: Result, output: str, quiet: bool = False) -> None:
    """Write a result: one JSON document on stdout, or text or CSV there with errors and remarks on stderr.

    Raises OSError if stdout or stderr takes no more, e.g. on a full disk.
    """
    if output == "json":
        json.dump(result.envelope(), sys.stdout, indent=2, allow_nan=False)
        sys.stdout.write("\n")
        sys.stdout.flush()
        return
    from rich.console import Console
    from rich.text import Text

    err = Console(stderr=True, highlight=False)
    if output == "csv":
        sys.stdout.write(result.csv)
        sys.stdout.flush()
    elif result.human is not None:
        console = Console(highlight=False)
        # rich itself ends the program where stdout is a closed pipe.
        with console.capture() as drawn:
            # A command, a path or a URL is to be copied: only the terminal itself wraps a line.
            console.print(Redrawn(result.human, visible), soft_wrap=True)
        sys.stdout.write(drawn.get())
        sys.stdout.flush()
    if not quiet:
        for message in result.messages:
            err.print(Text(f"note: {visible(message)}", style="yellow"), soft_wrap=True)
    for problem in result.errors:
        err.print(Text.assemble(("error: ", "bold red"), visible(problem.message)), soft_wrap=True)
        if problem.remedy:
            err.print(Text.assemble(("what to do: ", "bold"), visible(problem.remedy)), soft_wrap=True)


class Redrawn:
    """What is drawn, with each piece of text within a line changed by `words`.

    rich's own colours and control sequences stay.
    """

    def __init__(self, drawn: Drawn, words: Callable[[str], str]) -> None:
        self._drawn, self._words = drawn, words

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich.segment import Segment
        from rich.text import Text

        if isinstance(self._drawn, Sequence) and not isinstance(self._drawn, str):
            for part in self._drawn:
                yield Redrawn(part, self._words)
            return
        drawn = Text(self._drawn) if isinstance(self._drawn, str) else self._drawn
        for segment in console.render(drawn, options):
            yield segment if segment.control else Segment(self._words(segment.text), segment.style)
