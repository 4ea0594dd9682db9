"""HTTP handlers of the settings and of the commissioning."""

from __future__ import annotations

from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request

from tagid.commissioning.bench import TapeChanges
from tagid.commissioning.steps import step_named
from tagid.errors import UsageError
from tagid.station import wire
from tagid.station.commissioning import TAPE_NUMBERS, results_page, results_picture
from tagid.station.requests import Operations, body, key_of, text_of
from tagid.station.settings import DEVICE_KINDS
from tagid.station.station import Station

API = Operations()


@API.get("/api/v1/settings", "The settings of the page, and what the searches found", "Settings")
async def settings(station: Station, request: Request) -> wire.Json:
    return await run_in_threadpool(wire.settings, station)


@API.post("/api/v1/settings", "Change settings; all of them, or none", "Changes", 200, "Settings")
async def change(station: Station, request: Request) -> wire.Json:
    asked = await body(request)
    changes = asked.get("changes")
    if not isinstance(changes, dict):
        raise UsageError("changes must be an object", 'Send e.g. {"changes": {"radar.url": "..."}}.')
    await run_in_threadpool(station.change_settings, key_of(asked), changes)
    return await run_in_threadpool(wire.settings, station)


@API.post("/api/v1/settings/find", "Search for radars, or robots and tables", "Find", 200, "Settings")
async def find(station: Station, request: Request) -> wire.Json:
    asked = await body(request)
    name = text_of(asked, "kind", None)
    kind = next((kind for kind in DEVICE_KINDS if kind == name), None)
    if kind is None:
        raise UsageError(f"there is no search for {name[:40]!r}", f"Use {' or '.join(DEVICE_KINDS)}.")
    await run_in_threadpool(station.find_devices, key_of(asked), kind)
    return await run_in_threadpool(wire.settings, station)


@API.get("/api/v1/commissioning", "The steps of the commissioning with their results", "Commissioning")
async def commissioning(station: Station, request: Request) -> wire.Json:
    return await run_in_threadpool(wire.commissioning, station)


@API.post("/api/v1/commissioning", "Start or repeat a step", "StepStart", 202, "Empty")
async def start_step(station: Station, request: Request) -> wire.Json:
    asked = await body(request)
    step, tape = step_named(text_of(asked, "step", None)), _tape(asked.get("tape", {}))
    await run_in_threadpool(station.start_commissioning, key_of(asked), step, tape)
    return {}


@API.post(
    "/api/v1/commissioning/stop", "End the running step; earlier results are kept", "Empty", 202, "Empty"
)
async def stop_step(station: Station, request: Request) -> wire.Json:
    await body(request)
    station.stop_commissioning()
    return {}


@API.get(
    "/api/v1/commissioning/page.pdf", "The results as a page to be filed", "application/pdf", missing=True
)
async def page(station: Station, request: Request) -> bytes:
    return await run_in_threadpool(lambda: results_page(station.source.place().config))


@API.get(
    "/api/v1/commissioning/{step}/{number:int}.svg",
    "A picture of a step, by its number",
    "image/svg+xml",
    missing=True,
)
async def picture(station: Station, request: Request) -> bytes:
    step, number = step_named(request.path_params["step"]).name, request.path_params["number"]
    return await run_in_threadpool(lambda: results_picture(station.source.place().config, step, number))


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
