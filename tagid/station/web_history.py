"""HTTP handlers of the history, its export, and reports over a selection of it."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Generator
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.types import Send

from tagid.report.picture import thumbnail
from tagid.station import wire
from tagid.station.errors import NoSuchItemError
from tagid.station.reports import MEDIA, ReportRun
from tagid.station.requests import Operations, attached, body, entries_of, filter_of, key_of, number_in
from tagid.station.station import Station
from tagid.storage.history import HistoryEntry, csv_text

REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content policy of a report's page. The sandbox gives it an origin of its own, so that it can neither read
the station's page nor call its API; the page's own policy allows only its own script and style, by hash."""
_CHUNK = 1 << 18
API = Operations()
_HISTORY = "/api/v1/history"
_ENTRY = f"{_HISTORY}/{{number:number}}"
_REPORT = "/api/v1/reports/{number:number}"
_FILTERS: tuple[wire.Json, ...] = (
    *(
        {"name": name, "in": "query", "schema": {"type": "string"}}
        for name in ("status", "layout", "file", "since", "until")
    ),
    {"name": "limit", "in": "query", "schema": {"type": "integer"}},
    {
        "name": "entries",
        "in": "query",
        "schema": {"type": "string"},
        "description": "Numbers of entries, separated by commas.",
    },
)


@API.get(_HISTORY, "Identifications, newest first", "History", *_FILTERS)
async def history(station: Station, request: Request) -> wire.Json:
    entries = await _entries(station, request)
    available = await run_in_threadpool(station.available, entries)
    names = ("has_capture", "has_picture", "has_residuals")
    return {
        "items": [
            entry.to_json() | dict(zip(names, given, strict=True))
            for entry, given in zip(entries, available, strict=True)
        ]
    }


@API.get(f"{_HISTORY}.csv", "The same as a table", "text/csv", *_FILTERS)
async def history_csv(station: Station, request: Request) -> Response:
    text = csv_text(await _entries(station, request))
    return attached(text, "text/csv; charset=utf-8", "tagid-history.csv")


@API.get(f"{_HISTORY}.json", "The same as a JSON file", "application/json", *_FILTERS)
async def history_json(station: Station, request: Request) -> Response:
    text = wire.to_text(_items(await _entries(station, request)))
    return attached(text, "application/json", "tagid-history.json")


@API.get(
    f"{_HISTORY}/captures.zip",
    "The captures of the same entries with their table",
    "application/zip",
    *_FILTERS,
    missing=True,
)
async def captures(station: Station, request: Request) -> Response:
    entries = await _entries(station, request)
    paths = await run_in_threadpool(station.captures, tuple(entry.id for entry in entries))
    if not paths:
        raise NoSuchItemError("none of the captures is on this computer", "Select others.")
    headers = {"content-disposition": 'attachment; filename="tagid-captures.zip"'}
    return _Stream(archive(paths, entries), headers)


@API.get(f"{_ENTRY}/picture", "The picture of an identification", "image/png", missing=True)
async def picture(station: Station, request: Request) -> bytes:
    return await run_in_threadpool(station.picture, number_in(request))


@API.get(f"{_ENTRY}/thumbnail", "The same, small and without axes", "image/png", missing=True)
async def small_picture(station: Station, request: Request) -> bytes:
    return await run_in_threadpool(lambda: thumbnail(station.picture(number_in(request))))


@API.get(f"{_ENTRY}/residuals", "What its hypotheses leave of the echo, a picture", "image/png", missing=True)
async def residuals(station: Station, request: Request) -> bytes:
    return await run_in_threadpool(station.residuals, number_in(request))


@API.get(f"{_ENTRY}/capture", "The capture of an identification", "application/x-hdf5", missing=True)
async def capture(station: Station, request: Request) -> Response:
    path = await run_in_threadpool(station.capture, number_in(request))
    return FileResponse(path, media_type="application/x-hdf5", filename=path.name)


@API.post(f"{_ENTRY}/replay", "Show a capture as if it was recorded now", "Keyed", 202, "Started")
async def replay(station: Station, request: Request) -> wire.Json:
    key = key_of(await body(request))
    return {"number": await run_in_threadpool(station.start_replay, key, number_in(request))}


@API.post(
    "/api/v1/reports", "Begin a report over entries of the history", "ReportStart", 202, "ReportStarted"
)
async def start(station: Station, request: Request) -> wire.Json:
    asked = await body(request)
    entries = entries_of(asked.get("entries"))
    run = await run_in_threadpool(station.start_report, key_of(asked), entries)
    return {"number": run.number, "left_out": run.left_out}


@API.post("/api/v1/reports/stop", "Stop the report; finished captures are in it", "Keyed", 202, "Empty")
async def stop(station: Station, request: Request) -> wire.Json:
    station.operate(key_of(await body(request)))
    if (run := station.reports.newest) is not None:
        run.stop()
    return {}


@API.get(_REPORT, "Progress of a report", "Report", missing=True)
async def state(station: Station, request: Request) -> wire.Json:
    return wire.report(_run(station, request))


async def file(station: Station, request: Request) -> Response:
    """A file of a report: its name is a constant of the route."""
    run = _run(station, request)
    name = Path(request.url.path).name
    if not run.complete or name not in MEDIA:
        raise NoSuchItemError("the report is not complete", "Wait for its end.")
    path = run.folder / name
    if not path.is_file():
        raise NoSuchItemError("the report was removed")
    if name == "report.html":
        headers = {"content-security-policy": REPORT_POLICY}
        return FileResponse(path, media_type=MEDIA[name], headers=headers)
    return FileResponse(path, media_type=MEDIA[name], filename=f"report-{run.number}-{name}")


for _name, _media in MEDIA.items():
    _summary = f"{_name} of a complete report"
    API.get(f"{_REPORT}/{_name}", _summary, _media.partition(";")[0], missing=True)(file)


def _run(station: Station, request: Request) -> ReportRun:
    run = station.reports.get(number_in(request))
    if run is None:
        raise NoSuchItemError("there is no such report", "Begin one with POST /api/v1/reports.")
    return run


async def _entries(station: Station, request: Request) -> list[HistoryEntry]:
    return await run_in_threadpool(station.history, filter_of(request))


class _Stream(StreamingResponse):
    """A ZIP archive in pieces; its files are closed at once when the client is gone."""

    def __init__(self, pieces: Generator[bytes], headers: dict[str, str]) -> None:
        super().__init__(pieces, media_type="application/zip", headers=headers)
        self._pieces = pieces

    async def stream_response(self, send: Send) -> None:
        try:
            await super().stream_response(send)
        finally:
            self._pieces.close()


def _items(entries: list[HistoryEntry]) -> wire.Json:
    return {"items": [entry.to_json() for entry in entries]}


def archive(paths: list[Path], entries: list[HistoryEntry]) -> Generator[bytes]:
    """A ZIP archive of captures, not compressed again, with history.csv and history.json; in pieces.

    A capture that disappears meanwhile is left out.
    """
    out = _Pieces()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as packed:
        packed.writestr("history.csv", csv_text(entries))
        packed.writestr("history.json", json.dumps(_items(entries), indent=1))
        for path in paths:
            try:
                file = path.open("rb")
            except OSError:
                continue
            with file, packed.open(path.name, "w", force_zip64=True) as member:
                while piece := file.read(_CHUNK):
                    member.write(piece)
                    yield out.take()
        yield out.take()
    yield out.take()


class _Pieces:
    """The file methods that ZipFile needs to write without seeking; pieces are taken out as they come."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, data: Any) -> int:
        self._pieces.append(bytes(data))
        return len(data)

    def flush(self) -> None:
        """Does nothing: pieces are taken as they are."""

    def close(self) -> None:
        """Does nothing, as `flush`."""

    def take(self) -> bytes:
        """All bytes written since the last call."""
        content = b"".join(self._pieces)
        self._pieces.clear()
        return content
