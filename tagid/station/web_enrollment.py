"""HTTP handlers of the enrollment and of printed templates."""

from __future__ import annotations

from collections.abc import Callable

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from tagid.errors import UsageError
from tagid.operate.workplace import open_registry
from tagid.pipeline.enrollment import LayoutProposal
from tagid.report import layout_sheet
from tagid.report.drafting import PAPERS_MM
from tagid.report.pdf import to_pdf
from tagid.station import wire
from tagid.station.enrolling import Subject
from tagid.station.errors import NoSuchItemError
from tagid.station.requests import Body, Handler, Operations, attached, body, flag_of, key_of, text_of
from tagid.station.station import Station
from tagid.tags.layouts.layout import Layout

API = Operations()
_PLACE = "/api/v1/enrolment"
_TEMPLATE: tuple[wire.Json, ...] = (
    {"name": "paper", "in": "query", "schema": {"enum": list(PAPERS_MM), "default": "a4"}},
    {
        "name": "surface_radius_m",
        "in": "query",
        "schema": {"type": "number"},
        "description": "Radius of the surface that the strip wraps around.",
    },
)


def _act(name: str, summary: str, asked: str = "Keyed") -> Callable[[Handler], Handler]:
    return API.post(_PLACE + name, summary, asked, 200, "Enrolment")


async def _changed(
    station: Station, asked: Body, change: Callable[..., object], *values: object
) -> wire.Json:
    """The enrollment after a change that the operator asked for."""
    station.operate(key_of(asked))
    await run_in_threadpool(change, *values)
    return wire.enrolment(station.enrolling.state)


@API.get(_PLACE, "State of the enrolment", "Enrolment")
async def state(station: Station, request: Request) -> wire.Json:
    return wire.enrolment(station.enrolling.state)


@_act("", "Begin an enrollment, or change the name of the current one", "Subject")
async def describe(station: Station, request: Request) -> wire.Json:
    asked = await body(request)
    words = text_of(asked, "name", None), text_of(asked, "kind", "other"), text_of(asked, "label")
    return await _changed(station, asked, station.enrolling.describe, Subject(*words))


@API.post(
    f"{_PLACE}/capture", "Start a scan whose capture is added to the enrollment", "Keyed", 202, "Started"
)
async def capture(station: Station, request: Request) -> wire.Json:
    key = key_of(await body(request))
    return {"number": await run_in_threadpool(station.start_capture, key)}


@_act("/drop", "Remove a capture from the enrollment; its file is kept", "Drop")
async def drop(station: Station, request: Request) -> wire.Json:
    asked = await body(request)
    number = asked.get("number")
    if not isinstance(number, int) or isinstance(number, bool):
        raise UsageError("number must be the number of a capture")
    return await _changed(station, asked, station.enrolling.drop, number)


@_act("/store", "Enroll the object", "Store")
async def store(station: Station, request: Request) -> wire.Json:
    asked = await body(request)
    return await _changed(station, asked, station.enrolling.store, flag_of(asked, "force"))


@_act("/undo", "Undo the last enrollment of the station")
async def undo(station: Station, request: Request) -> wire.Json:
    return await _changed(station, await body(request), station.enrolling.undo)


@_act("/cancel", "End the enrollment without storing anything")
async def cancel(station: Station, request: Request) -> wire.Json:
    return await _changed(station, await body(request), station.enrolling.cancel)


@API.get(
    f"{_PLACE}/template.pdf",
    "Template at 1:1 of the measured layout",
    "application/pdf",
    *_TEMPLATE,
    missing=True,
)
async def own_template(station: Station, request: Request) -> Response:
    proposal = station.enrolling.state.proposal
    if not isinstance(proposal, LayoutProposal):
        raise NoSuchItemError("the enrollment has no reflector positions yet", "Record its captures.")
    return await _pdf(request, proposal.layout)


@API.get("/api/v1/layouts", "The enrolled layouts", "Layouts")
async def layouts(station: Station, request: Request) -> wire.Json:
    enrolled = await run_in_threadpool(open_registry().layouts)
    names = ("name", "kind", "label", "size")
    return {"items": [{name: getattr(entry, name) for name in names} for entry in enrolled]}


@API.get(
    "/api/v1/layouts/{name}/template.pdf",
    "Template at 1:1 of an enrolled layout",
    "application/pdf",
    *_TEMPLATE,
    missing=True,
)
async def template(station: Station, request: Request) -> Response:
    """The name is compared, never used as a path."""
    name = request.path_params["name"]
    for entry in await run_in_threadpool(open_registry().layouts):
        if entry.name == name:
            return await _pdf(request, entry)
    raise NoSuchItemError("there is no layout of that name", "See /api/v1/layouts.")


async def _pdf(request: Request, layout: Layout) -> Response:
    asked = request.query_params
    if unknown := set(asked) - {"paper", "surface_radius_m"}:
        raise UsageError(f"unknown parameter {min(unknown)[:40]!r}", "Use paper, surface_radius_m.")
    paper = asked.get("paper", "a4")
    text = asked.get("surface_radius_m")
    try:
        radius = float(text) if text else None
    except ValueError:
        raise UsageError("surface_radius_m is not a number", "Give metres, e.g. 0.11.") from None

    def drawn() -> bytes:
        return to_pdf(layout_sheet.template(layout, radius, paper), paper)

    return attached(await run_in_threadpool(drawn), "application/pdf", f"{layout.name}.pdf")
