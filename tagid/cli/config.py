"""`tagid config`: settings and their sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.frame import Terminal, command
from tagid.config import SETTINGS, change_file, load_config, parse_value, setting_named
from tagid.counting import meant
from tagid.errors import UsageError
from tagid.result import Result
from tagid.secret import Secret

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult

    from tagid.config import ConfigValue

_LEAST_MEANING = 28
"""Columns that the meaning of a setting needs beside the others, their gaps included."""


@command("config", negative_arguments=True)
def config(
    terminal: Terminal,
    action: Annotated[str, typer.Argument(help="show, set, unset or path.")] = "show",
    name: Annotated[str | None, typer.Argument(help="A setting, e.g. radar.url.")] = None,
    value: Annotated[str | None, typer.Argument(help="The new value.")] = None,
) -> Result:
    """Show or change the stored settings.

    Example: tagid config set radar.url udp://192.168.1.100
    """

    for word in (action, name, value):
        if word is not None and word.startswith("-") and not word[1:2].isdigit():
            raise UsageError(f"No such option: {word}", "`tagid config -h` shows the options.")
    if action in ("set", "unset"):
        if name is None or (value is None) != (action == "unset"):
            raise UsageError(
                f"tagid config {action} needs a setting" + (" and a value" * (action == "set")),
                "e.g. `tagid config set motion.axis_distance_m 1.0`, `tagid config unset radar.url`.",
            )
        if value is not None:
            _check_url(name, value)
        path = change_file(name, value)
        parsed = None if value is None else parse_value(name, value, "command line")
        in_its_unit = isinstance(parsed, float) and value is not None and value[-1:].isalpha()
        shown = str(parsed) if isinstance(parsed, Secret) or in_its_unit else value
        text = f"{name} = {shown}" if value is not None else f"{name} reset to its default"
        return Result("config", {"path": str(path), name: shown}, f"{text} ({path})")
    loaded = load_config()
    if action == "path":
        return Result("config", {"path": str(loaded.path)}, str(loaded.path))
    if action not in ("show", "list"):
        actions = ("show", "set", "unset", "path")
        raise UsageError(f"unknown action {action!r}", f"{meant(action, actions)}Use {', '.join(actions)}.")
    if name is not None:
        setting_named(name, "command line")
    rows = [
        _Row(setting.name, loaded.values[setting.name], setting.help)
        for setting in SETTINGS
        if name in (None, setting.name)
    ]
    data = {
        "path": str(loaded.path),
        "settings": {
            key: {"value": entry.value, "source": entry.source} for key, entry in loaded.values.items()
        },
    }
    return Result("config", data, _Listing(rows))


@dataclass(frozen=True)
class _Row:
    """A setting, its value with its source, and its meaning."""

    name: str
    entry: ConfigValue
    meaning: str

    @property
    def value(self) -> str:
        """As it is printed."""
        return "-" if self.entry.value is None else str(self.entry.value)


@dataclass(frozen=True)
class _Listing:
    """Settings as a table, or one below the other in a terminal too narrow for it.

    Names and values are copied by the user, so they are neither truncated nor wrapped.
    """

    rows: Sequence[_Row]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich.text import Text

        from tagid.report.table import Table

        columns = (
            [r.name for r in self.rows],
            [r.value for r in self.rows],
            [r.entry.source for r in self.rows],
        )
        if sum(max(map(len, words)) for words in columns) + _LEAST_MEANING > options.max_width:
            for row in self.rows:
                yield Text(f"{row.name} ({row.entry.source})", no_wrap=True, overflow="ignore")
                yield Text(f"  {row.value}", no_wrap=True, overflow="ignore")
                yield Text(f"  {row.meaning}", style="dim", no_wrap=True, overflow="ignore")
            return
        table = Table(box=None)
        for title in ("setting", "value", "from"):
            table.add_column(title, no_wrap=True)
        table.add_column("meaning", overflow="fold", ratio=1)
        for row in self.rows:
            table.add_row(row.name, row.value, row.entry.source, row.meaning)
        yield table


def _check_url(name: str, value: str) -> None:
    """Raises UsageError, with the valid forms, for a device URL that no command could open."""
    from contextlib import suppress

    from tagid.errors import MissingExtraError
    from tagid.motion.urls import open_motion
    from tagid.radar.urls import parse_radar_url

    if name == "radar.url":
        parse_radar_url(value)
    elif name == "motion.url":
        # A package that a device needs may be installed later.
        with suppress(MissingExtraError):
            open_motion(value)
