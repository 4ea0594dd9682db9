"""HTTP handlers of the settings, the range profile, and files that a browser sends."""

from __future__ import annotations

from urllib.parse import unquote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from tagid.errors import UsageError
from tagid.station import wire
from tagid.station.errors import NoSuchItemError
from tagid.station.requests import as_json, body, key_of, text_of
from tagid.station.security import KEY_HEADER, NAME_HEADER, UPLOAD_PATH
from tagid.station.settings import DEVICE_KINDS
from tagid.station.station import Station
from tagid.station.stored import receive


class SettingsHandlers:
    """Setting up the station, and files for it.

    Args:
        station: the station.
    """

    def __init__(self, station: Station) -> None:
        self._station = station

    def routes(self) -> list[BaseRoute]:
        """The routes of the handlers."""
        return [
            Route("/api/v1/settings", self.settings, methods=["GET"]),
            Route("/api/v1/settings", self.change, methods=["POST"]),
            Route("/api/v1/settings/find", self.find, methods=["POST"]),
            Route("/api/v1/profile", self.profile, methods=["GET"]),
            Route("/api/v1/profile", self.start_profile, methods=["POST"]),
            Route("/api/v1/profile/stop", self.stop_profile, methods=["POST"]),
            Route(UPLOAD_PATH, self.upload, methods=["POST"]),
        ]

    async def settings(self, request: Request) -> Response:
        return await self._shown()

    async def change(self, request: Request) -> Response:
        asked = await body(request)
        changes = asked.get("changes")
        if not isinstance(changes, dict):
            raise UsageError("changes must be an object", 'Send e.g. {"changes": {"radar.url": "..."}}.')
        await run_in_threadpool(self._station.change_settings, key_of(asked), changes)
        return await self._shown()

    async def find(self, request: Request) -> Response:
        asked = await body(request)
        name = text_of(asked, "kind", None)
        kind = next((kind for kind in DEVICE_KINDS if kind == name), None)
        if kind is None:
            raise UsageError(f"there is no search for {name[:40]!r}", f"Use {' or '.join(DEVICE_KINDS)}.")
        await run_in_threadpool(self._station.find_devices, key_of(asked), kind)
        return await self._shown()

    async def profile(self, request: Request) -> Response:
        if self._station.profile is None:
            raise NoSuchItemError("there is no range profile yet", "Start one with POST /api/v1/profile.")
        return as_json(wire.profile(self._station.profile))

    async def start_profile(self, request: Request) -> Response:
        key = key_of(await body(request))
        await run_in_threadpool(self._station.start_profile, key)
        return JSONResponse({}, status_code=202)

    async def stop_profile(self, request: Request) -> Response:
        await body(request)
        self._station.stop_profile()
        return JSONResponse({}, status_code=202)

    async def upload(self, request: Request) -> Response:
        """Store a capture and identify it. Who may not act is refused before the file is read."""
        station = self._station
        await run_in_threadpool(station.check_free, request.headers.get(KEY_HEADER))
        folder = await run_in_threadpool(lambda: station.source.place().folder())
        name = unquote(request.headers.get(NAME_HEADER, ""))
        path = await receive(request.stream(), folder, name)
        number = await run_in_threadpool(station.identify_received, path)
        return JSONResponse({"number": number, "file": path.name}, status_code=202)

    async def _shown(self) -> Response:
        shown = await run_in_threadpool(lambda: wire.settings(self._station))
        return as_json(shown)
