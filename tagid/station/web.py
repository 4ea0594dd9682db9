"""The station's HTTP application: thin handlers around `Station`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from importlib import resources
from typing import Any

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route, WebSocketRoute

from tagid.errors import TagidError
from tagid.station import wire
from tagid.station.live_socket import Hub, LiveSocket
from tagid.station.openapi import OPERATIONS, document
from tagid.station.requests import on_error, on_gone, on_missing
from tagid.station.security import PAGE_FILES, Guard, Guesses, Pairing
from tagid.station.station import Station


def build(station: Station, host: str, port: int, pairing: Pairing | None) -> Guard:
    """The guarded application, which listens at an address; without pairing on a loopback address."""
    hub = Hub(station)
    folder = resources.files("tagid.station") / "page_files"
    files = {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in PAGE_FILES.items()}
    files["/api/v1/openapi.json"] = wire.to_text(document()).encode(), "application/json"

    async def file(request: Request) -> Response:
        content, kind = files[request.url.path]
        return Response(content, media_type=kind)

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
        *(Route(path, file, methods=["GET"]) for path in files),
        *(Route(item.path, partial(item.respond, station), methods=[item.method]) for item in OPERATIONS),
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
    app.state.pairing, app.state.guesses = pairing, Guesses()
    return Guard(app, host, port, pairing)
