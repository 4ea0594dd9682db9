"""A command group that imports a command's module only when the command is called.

Help lists every command from a table, so that `tagid --help` costs no imports.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import typer
import typer.core
import typer.main


@dataclass(frozen=True)
class Entry:
    """A command that is imported on demand.

    Attributes:
        module: has a `register(app)`.
        help: one line, the first sentence of the command's help text.
    """

    module: str
    help: str


def lazy_group(entries: Mapping[str, Entry]) -> type[typer.core.TyperGroup]:
    """A group class with the commands of a table, in its order."""

    class Lazy(typer.core.TyperGroup):
        def list_commands(self, ctx: Any) -> list[str]:
            return list(entries)

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            entry = entries.get(cmd_name)
            if entry is None:
                return None
            if cmd_name not in self.commands:
                part = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)
                importlib.import_module(entry.module).register(part)
                self.commands.update(typer.main.get_group(part).commands)
            return self.commands.get(cmd_name)

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            with formatter.section("Commands"):
                formatter.write_dl([(name, entry.help) for name, entry in entries.items()])

    return Lazy
