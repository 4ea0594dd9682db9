"""`tagid history`: list, filter and export the identifications made on this computer."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tagid.cli.frame import Terminal, command
from tagid.cli.outputs import check_own
from tagid.errors import UsageError
from tagid.result import Result

_SHOWN = 20


class HistoryOutput(StrEnum):
    human = "human"
    json = "json"
    csv = "csv"


@command("history", HistoryOutput)
def history(
    terminal: Terminal,
    action: Annotated[str, typer.Argument(help="list or export.")] = "list",
    file: Annotated[Path | None, typer.Argument(help="For export: a .parquet or .csv file.")] = None,
    status: Annotated[
        str | None, typer.Option(help="identified, unknown, ambiguous, no_tag, failed.")
    ] = None,
    layout: Annotated[str | None, typer.Option(help="Name of a layout.")] = None,
    uuid: Annotated[str | None, typer.Option(help="UUID of a capture.")] = None,
    part: Annotated[str | None, typer.Option("--file", help="Part of the file name.")] = None,
    made_by: Annotated[
        str | None, typer.Option("--command", help="Command: scan, identify, report, station or python.")
    ] = None,
    since: Annotated[
        str | None, typer.Option(help="Only entries at or after this date or time, UTC.")
    ] = None,
    until: Annotated[str | None, typer.Option(help="Only entries before this date or time, UTC.")] = None,
    limit: Annotated[
        int | None,
        typer.Option(help="Number of newest entries to show; default: 20 on a terminal, otherwise all."),
    ] = None,
) -> Result:
    """List the identifications made on this computer, newest first, or export them.

    Example: tagid history --status unknown --since 2026-11-01
    Example: tagid history export answers.parquet
    """
    from rich.text import Text

    from tagid.config import data_folder
    from tagid.files import resolved
    from tagid.report.table import Table
    from tagid.storage.history import FILE_NAME, Filter, History, csv_text, export, is_export

    wanted = Filter(status, layout, uuid, made_by, part, since, until, limit)
    store = History(data_folder() / FILE_NAME)
    if action == "export":
        if file is None:
            raise UsageError("export needs a file", "Give e.g. `tagid history export answers.parquet`.")
        file = resolved(file)
        check_own(file, is_export, "an export of the history")
        rows = export(store, wanted, file)
        return Result("history", {"path": str(file), "rows": rows}, f"{rows} identifications in {file}")
    if action != "list" or file is not None:
        raise UsageError(f"unknown action {action!r}", "Use `tagid history` or `tagid history export FILE`.")
    total = store.count(wanted)
    if terminal.output == "human" and wanted.limit is None:
        wanted = replace(wanted, limit=_SHOWN)
    entries = list(store.find(wanted))
    items = [entry.to_json() for entry in entries]
    data = {"history": str(store.path), "total": total, "items": items}
    shown = Table("time (UTC)", "answer", "score", "margin", "by", "file")
    shown.columns[0].no_wrap = True
    colours = {"identified": "green", "failed": "red"}
    for entry in entries:
        answer = entry.layout or "" if entry.status == "identified" else entry.status.replace("_", " ")
        shown.add_row(
            entry.time_utc[:19].replace("T", " "),
            Text(answer, style=colours.get(entry.status, "yellow")),
            *("-" if entry.status == "failed" else f"{share:.2f}" for share in (entry.score, entry.margin)),
            entry.command,
            Text(entry.file, no_wrap=True),
        )
    notes = (f"the newest {len(entries)} of {total}; --limit shows more",) if total > len(entries) else ()
    if not total:
        notes = ("no matching entries",)
    return Result("history", data, shown, messages=notes, csv=csv_text(entries))
