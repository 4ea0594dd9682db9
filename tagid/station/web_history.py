"""HTTP handlers of the history, its export, and reports over a selection of it."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Generator
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Route
from starlette.types import Send

from tagid.report.picture import thumbnail
from tagid.station import wire
from tagid.station.errors import NoSuchItemError
from tagid.station.reports import MEDIA, ReportRun
from tagid.station.requests import (
    as_json,
    attached,
    body,
    entries_of,
    filter_of,
    key_of,
    number_in,
)
from tagid.station.station import Station
from tagid.storage.history import Filter, HistoryEntry, csv_text

REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content policy of a report's page. The sandbox gives it an origin of its own, so that it can neither read
the station's page nor call its API; the page's own policy allows only its own script and style, by hash."""
_CHUNK = 1 << 18


class HistoryHandlers:
    """The history and reports.

    Args:
        station: whose history it is.
    """

    def __init__(self, station: Station) -> None:
        self._station = station

    def routes(self) -> list[BaseRoute]:
        """The routes of the handlers."""
        report = "/api/v1/reports/{number:number}"
        return [
            Route("/api/v1/history", self.history, methods=["GET"]),
            Route("/api/v1/history.csv", self.history_csv, methods=["GET"]),
            Route("/api/v1/history.json", self.history_json, methods=["GET"]),
            Route("/api/v1/history/captures.zip", self.captures, methods=["GET"]),
            Route("/api/v1/history/{number:number}/picture", self.picture, methods=["GET"]),
            Route("/api/v1/history/{number:number}/thumbnail", self.thumbnail, methods=["GET"]),
            Route("/api/v1/history/{number:number}/residuals", self.residuals, methods=["GET"]),
            Route("/api/v1/history/{number:number}/capture", self.capture, methods=["GET"]),
            Route("/api/v1/history/{number:number}/replay", self.replay, methods=["POST"]),
            Route("/api/v1/reports", self.start, methods=["POST"]),
            Route("/api/v1/reports/stop", self.stop, methods=["POST"]),
            Route(report, self.state, methods=["GET"]),
            *(Route(f"{report}/{name}", self.file, name=name, methods=["GET"]) for name in MEDIA),
        ]

    async def history(self, request: Request) -> Response:
        entries = await self._entries(request)
        return as_json(await run_in_threadpool(self._listed, entries))

    async def history_csv(self, request: Request) -> Response:
        text = csv_text(await self._entries(request))
        return attached(text, "text/csv; charset=utf-8", "tagid-history.csv")

    async def history_json(self, request: Request) -> Response:
        text = wire.to_text(_items(await self._entries(request)))
        return attached(text, "application/json", "tagid-history.json")

    async def picture(self, request: Request) -> Response:
        content = await run_in_threadpool(self._station.picture, number_in(request))
        return Response(content, media_type="image/png")

    async def thumbnail(self, request: Request) -> Response:
        content = await run_in_threadpool(lambda: thumbnail(self._station.picture(number_in(request))))
        return Response(content, media_type="image/png")

    async def residuals(self, request: Request) -> Response:
        content = await run_in_threadpool(self._station.residuals, number_in(request))
        return Response(content, media_type="image/png")

    async def replay(self, request: Request) -> Response:
        key = key_of(await body(request))
        number = await run_in_threadpool(self._station.start_replay, key, number_in(request))
        return JSONResponse({"number": number}, status_code=202)

    async def capture(self, request: Request) -> Response:
        path = await run_in_threadpool(self._station.capture, number_in(request))
        return FileResponse(path, media_type="application/x-hdf5", filename=path.name)

    async def captures(self, request: Request) -> Response:
        """The captures of a selection with the list of their answers, as one archive."""
        entries = await self._entries(request)
        numbers = tuple(entry.id for entry in entries)
        paths = await run_in_threadpool(self._station.captures, numbers)
        if not paths:
            raise NoSuchItemError("none of the captures is on this computer", "Select others.")
        headers = {"content-disposition": 'attachment; filename="tagid-captures.zip"'}
        return _Stream(archive(paths, entries), headers)

    async def start(self, request: Request) -> Response:
        asked = await body(request)
        entries = entries_of(asked.get("entries"))
        run = await run_in_threadpool(self._station.start_report, key_of(asked), entries)
        return JSONResponse({"number": run.number, "left_out": run.left_out}, status_code=202)

    async def stop(self, request: Request) -> Response:
        self._station.operate(key_of(await body(request)))
        if (run := self._station.reports.newest) is not None:
            run.stop()
        return JSONResponse({}, status_code=202)

    async def state(self, request: Request) -> Response:
        return as_json(wire.report(self._run(request)))

    async def file(self, request: Request) -> Response:
        """A file of a report: its name is a constant of the route."""
        run = self._run(request)
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

    def _run(self, request: Request) -> ReportRun:
        run = self._station.reports.get(number_in(request))
        if run is None:
            raise NoSuchItemError("there is no such report", "Begin one with POST /api/v1/reports.")
        return run

    def _listed(self, entries: list[HistoryEntry]) -> wire.Json:
        """Entries with whether their capture and pictures can be requested."""
        available = self._station.available(entries)
        return {
            "items": [
                entry.to_json() | {"has_capture": capture, "has_picture": picture, "has_residuals": residuals}
                for entry, (capture, picture, residuals) in zip(entries, available, strict=True)
            ]
        }

    async def _entries(self, request: Request) -> list[HistoryEntry]:
        wanted: Filter = filter_of(request)
        return await run_in_threadpool(self._station.history, wanted)


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
