"""`tagid config` and `doctor`: settings and their sources, and problems of this computer."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.config import SETTINGS, change_settings, load_config, parse_value, setting_named
from tagid.counting import meant
from tagid.errors import EXIT_FAILED, EXIT_OK, MissingExtraError, UsageError
from tagid.result import Problem, Result
from tagid.secret import Secret

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult


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
        path = change_settings({name: value})
        parsed = None if value is None else parse_value(name, value)
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
        setting_named(name)
    chosen = [(item, loaded.values[item.name]) for item in SETTINGS if name in (None, item.name)]
    rows = [
        (item.name, "-" if entry.value is None else str(entry.value), entry.source, item.help)
        for item, entry in chosen
    ]
    data = {
        "path": str(loaded.path),
        "settings": {
            key: {"value": entry.value, "source": entry.source} for key, entry in loaded.values.items()
        },
    }
    return Result("config", data, _Listing(rows))


@dataclass(frozen=True)
class _Listing:
    """Rows of name, value, source and meaning, as a table, or below each other where that is too wide.

    Names and values are copied by the user, so they are neither truncated nor wrapped.
    """

    rows: Sequence[tuple[str, str, str, str]]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich.text import Text

        from tagid.report.table import Table

        wide = sum(max(map(len, words)) for words in list(zip(*self.rows, strict=True))[:3])
        if wide + _LEAST_MEANING > options.max_width:
            for name, value, source, meaning in self.rows:
                yield Text(f"{name} ({source})", no_wrap=True, overflow="ignore")
                yield Text(f"  {value}", no_wrap=True, overflow="ignore")
                yield Text(f"  {meaning}", style="dim", no_wrap=True, overflow="ignore")
            return
        yield Table("setting", "value", "from", "meaning", rows=self.rows, wraps=("meaning",))


def _check_url(name: str, value: str) -> None:
    """Raises UsageError, with the valid forms, for a device URL that no command could open."""
    from tagid.motion.urls import open_motion
    from tagid.radar.urls import parse_radar_url

    if name == "radar.url":
        parse_radar_url(value)
    elif name == "motion.url":
        # A package that a device needs may be installed later.
        with suppress(MissingExtraError):
            open_motion(value)


@command("doctor")
def doctor(terminal: Terminal, radar: options.RadarUrl = None) -> Result:
    """Check ports, radar, disk, layouts and versions.

    Example: tagid doctor --radar udp://192.168.1.100
    """
    from rich.text import Text

    from tagid.doctor import examine

    findings = examine(load_config({"radar.url": radar}), needs_radar=radar is not None)
    styles = {"ok": "green", "warning": "yellow", "problem": "bold red"}
    text = Text()
    for finding in findings:
        text.append(f"{finding.level:8}", style=styles[finding.level])
        text.append(f" {finding.topic:14} {finding.text}\n")
        if finding.remedy:
            text.append(f"         -> {finding.remedy}\n", style="bold")
    text.rstrip()
    problems = sum(finding.level == "problem" for finding in findings)
    return Result(
        "doctor",
        {"findings": [asdict(finding) for finding in findings], "problems": problems},
        text,
        exit_code=EXIT_FAILED if problems else EXIT_OK,
        errors=tuple(
            Problem("doctor", f"{f.topic}: {f.text}", f.remedy)
            for f in findings
            if f.level == "problem" and terminal.output == "json"
        ),
    )
