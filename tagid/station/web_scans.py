"""HTTP handlers of pairing, scans, the range profile, and files that a browser sends."""

from __future__ import annotations

import asyncio
from urllib.parse import unquote

from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from tagid.errors import UsageError
from tagid.station import wire
from tagid.station.errors import NoSuchItemError
from tagid.station.requests import Operations, body, key_of, refused, text_of
from tagid.station.security import COOKIE, KEY_HEADER, NAME_HEADER, UPLOAD_PATH, Guesses, Pairing
from tagid.station.station import Station
from tagid.station.stored import receive

GUESS_S = 0.1
"""Time from a wrong pairing code to the next comparison, of whatever client, s. Ten codes a second for a year
guess one of 31^8 with a probability of 4e-4."""
API = Operations()


@API.post("/api/v1/pair", "Create a token from the pairing code", "Pairing", 200, "Token", refused=(429,))
async def pair(station: Station, request: Request) -> Response:
    code = (await body(request)).get("code")
    pairing: Pairing | None = request.app.state.pairing
    guesses: Guesses = request.app.state.guesses
    if pairing is None:
        raise UsageError("no pairing is needed on this address")
    request.state.queued = True
    async with guesses.turn(request.client.host if request.client else ""):
        request.state.queued = False
        if await request.is_disconnected():
            raise ClientDisconnect
        token = pairing.pair(code) if isinstance(code, str) and len(code) <= 40 else None
        if token is None:
            await asyncio.sleep(GUESS_S)
    if token is None:
        return refused(403, "wrong_code", "this is not the pairing code", "Enter the most recent code.")
    response = JSONResponse({"token": token})
    response.set_cookie(COOKIE, token, httponly=True, samesite="strict", path="/")
    return response


@API.get("/api/v1/status", "State of the station", "Status")
async def status(station: Station, request: Request) -> wire.Json:
    return wire.status(station)


@API.get("/api/v1/scan", "The newest scan with its result so far", "Scan", missing=True)
async def scan(station: Station, request: Request) -> wire.Json:
    if station.scan is None:
        raise NoSuchItemError("no scan was started yet", "Start one with POST /api/v1/scan.")
    return wire.scan(station.scan)


@API.post("/api/v1/scan", "Start a scan", "Start", 202, "Started")
async def start(station: Station, request: Request) -> wire.Json:
    asked = await body(request)
    note, demo_object = text_of(asked, "note"), text_of(asked, "object")
    return {"number": await run_in_threadpool(station.start, key_of(asked), note, demo_object)}


@API.post("/api/v1/scan/stop", "Stop the scan and keep its capture", "Empty", 202, "Empty")
async def stop(station: Station, request: Request) -> wire.Json:
    await body(request)
    station.stop()
    return {}


@API.get(
    "/api/v1/scan/residuals", "What its hypotheses leave of the echo, a picture", "image/png", missing=True
)
async def residuals(station: Station, request: Request) -> bytes:
    return await run_in_threadpool(station.scan_residuals)


@API.get("/api/v1/profile", "The echo over range", "Profile", missing=True)
async def profile(station: Station, request: Request) -> wire.Json:
    if station.profile is None:
        raise NoSuchItemError("there is no range profile yet", "Start one with POST /api/v1/profile.")
    return wire.profile(station.profile)


@API.post("/api/v1/profile", "Show the echo over range, until a scan begins", "Keyed", 202, "Empty")
async def start_profile(station: Station, request: Request) -> wire.Json:
    await run_in_threadpool(station.start_profile, key_of(await body(request)))
    return {}


@API.post("/api/v1/profile/stop", "End the range profile", "Empty", 202, "Empty")
async def stop_profile(station: Station, request: Request) -> wire.Json:
    await body(request)
    station.stop_profile()
    return {}


def _header(name: str, description: str) -> wire.Json:
    return {"name": name, "in": "header", "schema": {"type": "string"}, "description": description}


@API.post(
    UPLOAD_PATH,
    "Store a capture and identify it",
    "application/octet-stream",
    202,
    "Received",
    _header(NAME_HEADER, "Percent-encoded name of the file."),
    _header(KEY_HEADER, "As key in the body of other requests."),
    refused=(413, 415),
)
async def upload(station: Station, request: Request) -> wire.Json:
    """Who may not act is refused before the file is read."""
    await run_in_threadpool(station.check_free, request.headers.get(KEY_HEADER))
    folder = await run_in_threadpool(lambda: station.source.place().folder())
    path = await receive(request.stream(), folder, unquote(request.headers.get(NAME_HEADER, "")))
    return {"number": await run_in_threadpool(station.identify_received, path), "file": path.name}
