"""HTTP handlers of the enrollment and of printed templates."""

from __future__ import annotations

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from tagid.errors import UsageError
from tagid.pipeline.enrollment import LayoutProposal
from tagid.report import layout_sheet
from tagid.report.pdf import to_pdf
from tagid.station import wire
from tagid.station.enrolling import Subject
from tagid.station.errors import NoSuchItemError
from tagid.station.requests import as_json, attached, body, flag_of, key_of, text_of
from tagid.station.station import Station
from tagid.tags.layouts.layout import Layout


class EnrolmentHandlers:
    """The enrollment.

    Args:
        station: whose enrollment it is.
    """

    def __init__(self, station: Station) -> None:
        self._station = station

    def routes(self) -> list[BaseRoute]:
        """The routes of the handlers."""
        return [
            Route("/api/v1/enrolment", self.state, methods=["GET"]),
            Route("/api/v1/enrolment", self.describe, methods=["POST"]),
            Route("/api/v1/enrolment/capture", self.capture, methods=["POST"]),
            Route("/api/v1/enrolment/drop", self.drop, methods=["POST"]),
            Route("/api/v1/enrolment/store", self.store, methods=["POST"]),
            Route("/api/v1/enrolment/undo", self.undo, methods=["POST"]),
            Route("/api/v1/enrolment/cancel", self.cancel, methods=["POST"]),
            Route("/api/v1/enrolment/template.pdf", self.own_template, methods=["GET"]),
            Route("/api/v1/layouts", self.layouts, methods=["GET"]),
            Route("/api/v1/layouts/{name}/template.pdf", self.template, methods=["GET"]),
        ]

    async def state(self, request: Request) -> Response:
        return self._answer()

    async def describe(self, request: Request) -> Response:
        asked = await body(request)
        subject = Subject(
            text_of(asked, "name", None), text_of(asked, "kind", "other"), text_of(asked, "label")
        )
        await run_in_threadpool(self._station.describe, key_of(asked), subject)
        return self._answer()

    async def capture(self, request: Request) -> Response:
        key = key_of(await body(request))
        number = await run_in_threadpool(self._station.start_capture, key)
        return JSONResponse({"number": number}, status_code=202)

    async def drop(self, request: Request) -> Response:
        asked = await body(request)
        number = asked.get("number")
        if not isinstance(number, int) or isinstance(number, bool):
            raise UsageError("number must be the number of a capture")
        self._station.operate(key_of(asked))
        await run_in_threadpool(self._station.enrolling.drop, number)
        return self._answer()

    async def store(self, request: Request) -> Response:
        asked = await body(request)
        force = flag_of(asked, "force")
        self._station.operate(key_of(asked))
        await run_in_threadpool(self._station.enrolling.store, force)
        return self._answer()

    async def undo(self, request: Request) -> Response:
        self._station.operate(key_of(await body(request)))
        await run_in_threadpool(self._station.enrolling.undo)
        return self._answer()

    async def cancel(self, request: Request) -> Response:
        self._station.operate(key_of(await body(request)))
        self._station.enrolling.cancel()
        return self._answer()

    async def own_template(self, request: Request) -> Response:
        """The template of the layout that was just measured."""
        proposal = self._station.enrolling.state.proposal
        if not isinstance(proposal, LayoutProposal):
            raise NoSuchItemError("the enrollment has no reflector positions yet", "Record its captures.")
        return await self._pdf(request, proposal.layout)

    async def layouts(self, request: Request) -> Response:
        enrolled = await run_in_threadpool(self._station.layouts)
        items = [
            {"name": entry.name, "kind": entry.kind, "label": entry.label, "size": entry.size}
            for entry in enrolled
        ]
        return as_json({"items": items})

    async def template(self, request: Request) -> Response:
        """The template of an enrolled layout; the name is compared, never used as a path."""
        name = request.path_params["name"]
        for entry in await run_in_threadpool(self._station.layouts):
            if entry.name == name:
                return await self._pdf(request, entry)
        raise NoSuchItemError("there is no layout of that name", "See /api/v1/layouts.")

    async def _pdf(self, request: Request, layout: Layout) -> Response:
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

        content = await run_in_threadpool(drawn)
        return attached(content, "application/pdf", f"{layout.name}.pdf")

    def _answer(self) -> Response:
        return as_json(wire.enrolment(self._station.enrolling.state))
