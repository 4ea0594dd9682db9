"""Values of the command line without pydantic: the same values, and typer's own messages for invalid ones."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer

from tagid.cli.common.plain_values import PlainCommand


class Colour(StrEnum):
    """Choices of an option."""

    red = "red"
    blue = "blue"


def commands() -> list[Any]:
    """One command twice: with the quick conversion, and as typer makes it."""
    made = []
    for kind in (PlainCommand, None):
        app = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False, add_completion=False)

        @app.command(cls=kind)
        def run(
            files: list[Path],
            count: Annotated[int, typer.Option("--count")] = 3,
            share: Annotated[float, typer.Option("--share", min=0, max=20)] = 0.5,
            name: Annotated[str | None, typer.Option("--name")] = None,
            colour: Annotated[Colour, typer.Option("--colour")] = Colour.red,
            flag: Annotated[bool, typer.Option("--flag")] = False,
            place: Annotated[Path | None, typer.Option("--place")] = None,
            existing: Annotated[Path | None, typer.Option("--existing", exists=True)] = None,
        ) -> None:
            said.append((files, count, share, name, colour, flag, place, existing))

        made.append(app)
    return made


said: list[tuple[Any, ...]] = []


@pytest.mark.parametrize(
    "words",
    [
        "a b",
        "a --count 12 --share 1e1 --name x --colour blue --flag --place p",
        "a --count -7 --share 0",
        "a --share 20.",
        "a --count  +5 --share .5 --name 12",
        "a --count 1_000",
        "a --count twelve",
        "a --count 1.5",
        "a --share -0.1",
        "a --share nan",
        "a --share 1,5",
        "a --colour green",
        "a --colour RED",
        "a --existing /",
        "a --existing /nothing/here",
        "",
    ],
)
def test_values_and_errors_are_typers(words: str) -> None:
    outcomes = []
    for app in commands():
        said.clear()
        try:
            app(words.split(), standalone_mode=False)
            values = said[0]
            outcomes.append((values, [type(value) for value in values]))
        except typer.TyperException as error:
            outcomes.append((error.format_message(), [type(error)]))
    assert outcomes[0] == outcomes[1]
