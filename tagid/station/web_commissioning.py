"""HTTP handlers of the commissioning."""

from __future__ import annotations

from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from tagid.commissioning.bench import TapeChanges
from tagid.commissioning.steps import step_named
from tagid.errors import UsageError
from tagid.station import wire
from tagid.station.commissioning import TAPE_NUMBERS
from tagid.station.requests import as_json, body, key_of, text_of
from tagid.station.station import Station


class CommissioningHandlers:
    """State, start and stop of the steps.

    Args:
        station: the station.
    """

    def __init__(self, station: Station) -> None:
        self._station = station

    def routes(self) -> list[BaseRoute]:
        """The routes of the handlers."""
        return [
            Route("/api/v1/commissioning", self.state, methods=["GET"]),
            Route("/api/v1/commissioning", self.start, methods=["POST"]),
            Route("/api/v1/commissioning/stop", self.stop, methods=["POST"]),
            Route("/api/v1/commissioning/page.pdf", self.page, methods=["GET"]),
            Route("/api/v1/commissioning/{step}/{number:int}.svg", self.picture, methods=["GET"]),
        ]

    async def state(self, request: Request) -> Response:
        return as_json(await run_in_threadpool(lambda: wire.commissioning(self._station)))

    async def start(self, request: Request) -> Response:
        asked = await body(request)
        step = step_named(text_of(asked, "step", None))
        tape = _tape(asked.get("tape", {}))
        await run_in_threadpool(self._station.start_commissioning, key_of(asked), step, tape)
        return JSONResponse({}, status_code=202)

    async def stop(self, request: Request) -> Response:
        await body(request)
        self._station.stop_commissioning()
        return JSONResponse({}, status_code=202)

    async def page(self, request: Request) -> Response:
        content = await run_in_threadpool(self._station.commissioning_page)
        return Response(content, media_type="application/pdf")

    async def picture(self, request: Request) -> Response:
        step, number = step_named(request.path_params["step"]).name, request.path_params["number"]
        content = await run_in_threadpool(self._station.commissioning_picture, step, number)
        return Response(content, media_type="image/svg+xml")


def _tape(given: Any) -> TapeChanges:
    """What was measured by tape. Raises UsageError."""
    if not isinstance(given, dict) or given.keys() - {"target", *TAPE_NUMBERS}:
        raise UsageError("tape is no object of lengths", f"Give target, {', '.join(TAPE_NUMBERS)}.")
    tape: dict[str, str | float] = {}
    for name in TAPE_NUMBERS:
        value = given.get(name)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 100:
            raise UsageError(f"{name} is {str(value)[:40]}", "Give metres, e.g. 1.02.")
        tape[name] = float(value)
    target = given.get("target")
    if target is not None:
        tape["target"] = text_of(given, "target")
    return tape
