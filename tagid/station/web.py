"""The station's HTTP and WebSocket application: thin handlers around `Station`."""

from __future__ import annotations

import asyncio
import csv
import io
import json
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from importlib import resources
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from tagid import __version__
from tagid.errors import DeviceError, StorageError, TagidError, UsageError
from tagid.station import wire
from tagid.station.openapi import document
from tagid.station.operators import NotOperatorError
from tagid.station.security import COOKIE, MOST_BODY_BYTES, Guard, Pairing
from tagid.station.station import HISTORY_LIMIT, BusyError, NoSuchItemError, Station
from tagid.storage.history import FIELDS, Filter
from tagid.storage.spreadsheet import cell

MAX_CONNECTIONS = 32
"""Maximum number of WebSocket connections."""
FRAME_S = 0.1
_STATUS_S = 1.0
_SEND_S = 10.0
"""Time after which a client that does not accept a frame is disconnected, s."""
_MESSAGES_PER_SECOND = 20
PAIR_PAUSE_S = 1.0
"""Delay after a wrong pairing code, s."""
_PAGE_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/station.css": ("station.css", "text/css; charset=utf-8"),
    "/station.js": ("station.js", "text/javascript; charset=utf-8"),
    "/station.svg": ("station.svg", "image/svg+xml"),
}
"""The page: path of a request -> file of the package. File paths are never derived from requests."""


class Hub:
    """Sends new states to every connection; each has at most one unsent frame and one unsent status.

    Args:
        station: the station to show.
    """

    def __init__(self, station: Station) -> None:
        self._station = station
        self._clients: set[Client] = set()

    @property
    def count(self) -> int:
        """Number of connections."""
        return len(self._clients)

    def add(self, client: Client) -> None:
        """Send the complete state to a new connection."""
        self._clients.add(client)
        self._post(client, "status", wire.to_text(wire.status(self._station)))
        if (run := self._station.scan) is not None:
            self._post(client, "frame", wire.to_text(wire.frame(run)))

    def remove(self, client: Client) -> None:
        """Remove a connection."""
        self._clients.discard(client)

    def refresh(self) -> None:
        """Send the status to all now."""
        text = wire.to_text(wire.status(self._station))
        for client in self._clients:
            self._post(client, "status", text)

    async def run(self) -> None:
        """Poll for new states until cancelled."""
        shown: tuple[int, int, bool] | None = None
        status_at = 0.0
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(FRAME_S)
            self._station.tick()
            run = self._station.scan
            now = loop.time()
            seen = None if run is None else (run.number, run.state.frame, run.running)
            if run is not None and seen != shown and self._clients:
                text = wire.to_text(wire.frame(run))
                for client in self._clients:
                    self._post(client, "frame", text)
            if now >= status_at or (shown and seen and shown[2] != seen[2]):
                status_at = now + _STATUS_S
                self.refresh()
            shown = seen

    @staticmethod
    def _post(client: Client, kind: str, text: str) -> None:
        client.unsent[kind] = text
        client.news.set()


class Client:
    """One WebSocket connection.

    Attributes:
        key: of its operator's lock.
        unsent: the newest unsent text of each kind.
        news: set when there is something to send.
    """

    def __init__(self, key: str) -> None:
        self.key = key
        self.unsent: dict[str, str] = {}
        self.news = asyncio.Event()


def build(station: Station, host: str, port: int, pairing: Pairing | None) -> Guard:
    """The guarded application.

    Args:
        station: the station to show and operate.
        host, port: where it listens.
        pairing: None on a loopback address.
    """
    hub = Hub(station)
    handlers = _Handlers(station, hub, pairing)

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        task = asyncio.create_task(hub.run())
        yield
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    pages = [Route(path, handlers.page, methods=["GET"]) for path in _PAGE_FILES]
    api = [
        Route("/api/v1/openapi.json", handlers.openapi, methods=["GET"]),
        Route("/api/v1/pair", handlers.pair, methods=["POST"]),
        Route("/api/v1/status", handlers.status, methods=["GET"]),
        Route("/api/v1/scan", handlers.scan, methods=["GET"]),
        Route("/api/v1/scan", handlers.start, methods=["POST"]),
        Route("/api/v1/scan/stop", handlers.stop, methods=["POST"]),
        Route("/api/v1/history", handlers.history, methods=["GET"]),
        Route("/api/v1/history.csv", handlers.history_csv, methods=["GET"]),
        Route("/api/v1/history/{number:int}/picture", handlers.picture, methods=["GET"]),
        WebSocketRoute("/api/v1/live", handlers.live),
    ]
    errors: dict[Any, Any] = {TagidError: _error, 404: _not_found, 405: _not_found, Exception: _error}
    app = Starlette(routes=[*pages, *api], lifespan=lifespan, exception_handlers=errors)
    return Guard(app, host, port, pairing)


class _Handlers:
    """The handlers of the routes."""

    def __init__(self, station: Station, hub: Hub, pairing: Pairing | None) -> None:
        self._station, self._hub, self._pairing = station, hub, pairing
        folder = resources.files("tagid.station") / "page_files"
        self._pages = {
            path: ((folder / name).read_bytes(), kind) for path, (name, kind) in _PAGE_FILES.items()
        }

    async def page(self, request: Request) -> Response:
        body, kind = self._pages[request.url.path]
        return Response(body, media_type=kind)

    async def openapi(self, request: Request) -> Response:
        return JSONResponse(document())

    async def pair(self, request: Request) -> Response:
        code = (await _body(request)).get("code")
        if self._pairing is None:
            raise UsageError("no pairing is needed on this address")
        token = self._pairing.pair(code) if isinstance(code, str) and len(code) <= 40 else None
        if token is None:
            await asyncio.sleep(PAIR_PAUSE_S)
            return _refused(403, "wrong_code", "this is not the pairing code", "Enter the most recent code.")
        response = JSONResponse({"token": token})
        response.set_cookie(COOKIE, token, httponly=True, samesite="strict", path="/")
        return response

    async def status(self, request: Request) -> Response:
        return _json(wire.status(self._station))

    async def scan(self, request: Request) -> Response:
        run = self._station.scan
        if run is None:
            raise NoSuchItemError("no scan was started yet", "Start one with POST /api/v1/scan.")
        return _json(wire.scan(run))

    async def start(self, request: Request) -> Response:
        asked = await _body(request)
        key, note = asked.get("key"), asked.get("note", "")
        if not (key is None or isinstance(key, str)) or not isinstance(note, str):
            raise UsageError("key and note must be strings")
        number = await run_in_threadpool(self._station.start, key, note)
        return JSONResponse({"number": number}, status_code=202)

    async def stop(self, request: Request) -> Response:
        await _body(request)
        self._station.stop()
        return JSONResponse({}, status_code=202)

    async def history(self, request: Request) -> Response:
        rows = await run_in_threadpool(self._station.history, _filter(request))
        return _json({"items": rows})

    async def history_csv(self, request: Request) -> Response:
        rows = await run_in_threadpool(self._station.history, _filter(request))
        text = io.StringIO()
        table = csv.DictWriter(text, FIELDS)
        table.writeheader()
        table.writerows({name: cell(value) for name, value in row.items()} for row in rows)
        headers = {"content-disposition": 'attachment; filename="tagid-history.csv"'}
        return Response(text.getvalue(), media_type="text/csv; charset=utf-8", headers=headers)

    async def picture(self, request: Request) -> Response:
        number = int(request.path_params["number"])
        if number >= 1 << 63:
            raise NoSuchItemError("there is no such entry")
        return Response(await run_in_threadpool(self._station.picture, number), media_type="image/png")

    async def live(self, socket: WebSocket) -> None:
        if self._hub.count >= MAX_CONNECTIONS:
            await socket.close(1013)
            return
        await socket.accept()
        operators = self._station.operators
        try:
            key = operators.join(await _hello(socket))
        except (WebSocketDisconnect, _BadMessageError, TimeoutError):
            await _close(socket, 1008)
            return
        client = Client(key)
        hello = {"type": "hello", "key": key, "version": __version__, "palette": wire.palette()}
        client.unsent["hello"] = wire.to_text({**hello, "demo": self._station.source.demo})
        self._hub.add(client)
        tasks = [
            asyncio.create_task(self._send(socket, client)),
            asyncio.create_task(self._receive(socket, client)),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._hub.remove(client)
            operators.leave(key)
            for task in tasks:
                task.cancel()
            done = await asyncio.gather(*tasks, return_exceptions=True)
            bad = any(isinstance(one, _BadMessageError) for one in done)
            await _close(socket, 1008 if bad else 1011)

    async def _send(self, socket: WebSocket, client: Client) -> None:
        mine: bool | None = None
        while True:
            await client.news.wait()
            client.news.clear()
            holds = self._station.operators.holds(client.key)
            if holds != mine:
                mine = holds
                client.unsent["operator"] = wire.to_text({"type": "operator", "you": holds})
            while client.unsent:
                kind = next(iter(client.unsent))
                text = client.unsent.pop(kind)
                # Not wait_for: before Python 3.12 it swallows a cancellation when the send is just done.
                async with asyncio.timeout(_SEND_S):
                    await socket.send_text(text)

    async def _receive(self, socket: WebSocket, client: Client) -> None:
        loop = asyncio.get_running_loop()
        window, count = loop.time(), 0
        while True:
            message = _message(await socket.receive())
            if loop.time() - window > 1.0:
                window, count = loop.time(), 0
            count += 1
            if count > _MESSAGES_PER_SECOND:
                raise _BadMessageError
            await self._act(client, message)

    async def _act(self, client: Client, message: dict[str, Any]) -> None:
        """Execute a message; a refusal is reported to its sender."""
        station, kind = self._station, message.get("type")
        try:
            if kind == "scan":
                note = message.get("note", "")
                if not isinstance(note, str):
                    raise _BadMessageError
                await run_in_threadpool(station.start, client.key, note)
            elif kind == "stop":
                station.stop()
            elif kind == "take":
                if not station.take_over(client.key):
                    raise BusyError("another browser operates the scan that is running", "Wait for its end.")
            elif kind == "release":
                station.release(client.key)
            else:
                raise _BadMessageError
        except TagidError as error:
            client.unsent["error"] = wire.to_text({"type": "error", "error": _entry(error)})
        self._hub.refresh()


class _BadMessageError(Exception):
    """A client sent an invalid message."""


async def _hello(socket: WebSocket) -> str | None:
    """The key in the first message of a connection. Raises _BadMessageError, TimeoutError."""
    async with asyncio.timeout(_SEND_S):
        message = _message(await socket.receive())
    key = message.get("key")
    if message.get("type") != "hello" or not (key is None or isinstance(key, str)):
        raise _BadMessageError
    return key


def _message(received: Any) -> dict[str, Any]:
    """The JSON object of a text frame. Raises _BadMessageError, WebSocketDisconnect."""
    if received["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(received.get("code", 1005))
    try:
        found = json.loads(received.get("text") or "")
    except (ValueError, RecursionError):
        raise _BadMessageError from None
    if not isinstance(found, dict):
        raise _BadMessageError
    return found


async def _close(socket: WebSocket, code: int) -> None:
    if socket.application_state is WebSocketState.CONNECTED:
        with suppress(Exception):
            async with asyncio.timeout(1.0):
                await socket.close(code)


async def _body(request: Request) -> dict[str, Any]:
    """The JSON object of a request; empty without a body. Raises UsageError."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MOST_BODY_BYTES:
            raise UsageError("the body is too large")
    try:
        found = json.loads(body or b"{}")
    except (ValueError, RecursionError):
        raise UsageError("the body is not JSON") from None
    if not isinstance(found, dict):
        raise UsageError("the body is not a JSON object")
    return found


def _filter(request: Request) -> Filter:
    """The filter of a query. Raises UsageError."""
    asked = request.query_params
    known = {"status", "layout", "file", "since", "until", "limit"}
    if unknown := set(asked) - known:
        raise UsageError(f"unknown filter {min(unknown)[:40]!r}", f"Use {', '.join(sorted(known))}.")
    limit = asked.get("limit", "50")
    if not (limit.isascii() and limit.isdecimal() and len(limit) <= 4 and 1 <= int(limit) <= HISTORY_LIMIT):
        raise UsageError("the limit is out of range", f"Give 1 to {HISTORY_LIMIT}.")
    return Filter(
        status=asked.get("status") or None,
        layout=asked.get("layout") or None,
        file=asked.get("file") or None,
        since=asked.get("since") or None,
        until=asked.get("until") or None,
        limit=int(limit),
    )


def _json(value: dict[str, Any]) -> Response:
    return Response(wire.to_text(value), media_type="application/json")


def _entry(error: TagidError) -> dict[str, str]:
    return {"code": error.code, "message": error.message, "remedy": error.remedy}


def _refused(status: int, code: str, message: str, remedy: str) -> Response:
    entry = {"code": code, "message": message, "remedy": remedy}
    return JSONResponse({"error": entry}, status_code=status)


async def _error(request: Request, error: Exception) -> Response:
    if not isinstance(error, TagidError):
        logging.getLogger("tagid").error("%s: %s: %s", request.url.path, type(error).__name__, error)
        return _refused(500, "failed", "the station failed to answer", "See its log for the reason.")
    statuses: tuple[tuple[type[TagidError], int], ...] = (
        (BusyError, 409),
        (NotOperatorError, 403),
        (NoSuchItemError, 404),
        (UsageError, 400),
        (DeviceError, 503),
        (StorageError, 507),
    )
    status = next((code for kind, code in statuses if isinstance(error, kind)), 500)
    return _refused(status, error.code, error.message, error.remedy)


async def _not_found(request: Request, error: Exception) -> Response:
    return _refused(404, "not_found", "there is no such address", "See /api/v1/openapi.json.")
