"""The station's HTTP application: thin handlers around `Station`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import resources
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from tagid.errors import TagidError, UsageError
from tagid.station import wire
from tagid.station.errors import NoSuchItemError
from tagid.station.live_socket import Hub, LiveSocket
from tagid.station.openapi import document
from tagid.station.page import PAGE_FILES
from tagid.station.requests import as_json, body, key_of, on_error, on_gone, on_missing, refused, text_of
from tagid.station.security import COOKIE, Guard, Guesses, Pairing
from tagid.station.station import Station
from tagid.station.web_commissioning import CommissioningHandlers
from tagid.station.web_enrollment import EnrolmentHandlers
from tagid.station.web_history import HistoryHandlers
from tagid.station.web_settings import SettingsHandlers

GUESS_S = 0.1
"""Time from a wrong pairing code to the next comparison, of whatever client, s. Ten codes a second for a year
guess one of 31^8 with a probability of 4e-4."""


def build(station: Station, host: str, port: int, pairing: Pairing | None) -> Guard:
    """The guarded application.

    Args:
        station: the station to show and operate.
        host, port: where it listens.
        pairing: None on a loopback address.
    """
    hub = Hub(station)
    handlers = _Handlers(station, pairing)

    def ended(task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            station.fail("the thread that shows scans", error)

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        task = asyncio.create_task(hub.run())
        task.add_done_callback(ended)
        yield
        task.cancel()
        await asyncio.wait([task])

    routes: list[BaseRoute] = [
        *(Route(path, handlers.page, methods=["GET"]) for path in PAGE_FILES),
        Route("/api/v1/openapi.json", handlers.openapi, methods=["GET"]),
        Route("/api/v1/pair", handlers.pair, methods=["POST"]),
        Route("/api/v1/status", handlers.status, methods=["GET"]),
        Route("/api/v1/scan", handlers.scan, methods=["GET"]),
        Route("/api/v1/scan", handlers.start, methods=["POST"]),
        Route("/api/v1/scan/stop", handlers.stop, methods=["POST"]),
        Route("/api/v1/scan/residuals", handlers.residuals, methods=["GET"]),
        *HistoryHandlers(station).routes(),
        *EnrolmentHandlers(station).routes(),
        *SettingsHandlers(station).routes(),
        *CommissioningHandlers(station).routes(),
        WebSocketRoute("/api/v1/live", LiveSocket(station, hub).serve),
    ]
    errors: dict[Any, Any] = {
        TagidError: on_error,
        ClientDisconnect: on_gone,
        404: on_missing,
        405: on_missing,
        Exception: on_error,
    }
    app = Starlette(routes=routes, lifespan=lifespan, exception_handlers=errors)
    return Guard(app, host, port, pairing)


class _Handlers:
    """The page, pairing and scans."""

    def __init__(self, station: Station, pairing: Pairing | None) -> None:
        self._station, self._pairing, self._guesses = station, pairing, Guesses()
        self._document = wire.to_text(document())
        folder = resources.files("tagid.station") / "page_files"
        self._pages = {
            path: ((folder / name).read_bytes(), kind) for path, (name, kind) in PAGE_FILES.items()
        }

    async def page(self, request: Request) -> Response:
        content, kind = self._pages[request.url.path]
        return Response(content, media_type=kind)

    async def openapi(self, request: Request) -> Response:
        return Response(self._document, media_type="application/json")

    async def pair(self, request: Request) -> Response:
        code = (await body(request)).get("code")
        if self._pairing is None:
            raise UsageError("no pairing is needed on this address")
        request.state.queued = True
        async with self._guesses.turn(request.client.host if request.client else ""):
            request.state.queued = False
            if await request.is_disconnected():
                raise ClientDisconnect
            token = self._pairing.pair(code) if isinstance(code, str) and len(code) <= 40 else None
            if token is None:
                await asyncio.sleep(GUESS_S)
        if token is None:
            return refused(403, "wrong_code", "this is not the pairing code", "Enter the most recent code.")
        response = JSONResponse({"token": token})
        response.set_cookie(COOKIE, token, httponly=True, samesite="strict", path="/")
        return response

    async def status(self, request: Request) -> Response:
        return as_json(wire.status(self._station))

    async def scan(self, request: Request) -> Response:
        run = self._station.scan
        if run is None:
            raise NoSuchItemError("no scan was started yet", "Start one with POST /api/v1/scan.")
        return as_json(wire.scan(run))

    async def start(self, request: Request) -> Response:
        asked = await body(request)
        note, demo_object = text_of(asked, "note"), text_of(asked, "object")
        number = await run_in_threadpool(self._station.start, key_of(asked), note, demo_object)
        return JSONResponse({"number": number}, status_code=202)

    async def residuals(self, request: Request) -> Response:
        content = await run_in_threadpool(self._station.scan_residuals)
        return Response(content, media_type="image/png")

    async def stop(self, request: Request) -> Response:
        await body(request)
        self._station.stop()
        return JSONResponse({}, status_code=202)
