"""The description of the JSON API, OpenAPI 3.1.

msgspec would write the 26 schemas from 26 classes with the same 107 members, for 696 KB and 11 ms at every
start; the answers, which are dictionaries, would have to become their instances first.
"""

from __future__ import annotations

from typing import Any

from tagid._version import __version__
from tagid.commissioning.rows import Level
from tagid.commissioning.steps import STEPS
from tagid.report.drafting import PAPERS_MM
from tagid.station.commissioning import TAPE_NUMBERS
from tagid.station.reports import MEDIA
from tagid.station.security import COOKIE, KEY_HEADER, NAME_HEADER, OWN_HEADER, UPLOAD_PATH
from tagid.station.settings import DEVICE_KINDS, NAMES
from tagid.station.station import HISTORY_LIMIT
from tagid.storage.history import FIELDS, STATUSES, TYPES
from tagid.tags.layouts.layout import KINDS

_OWN = {"name": OWN_HEADER, "in": "header", "required": True, "schema": {"type": "string", "const": "1"}}
_KINDS = {str: "string", int: "integer", float: "number"}


def document() -> dict[str, Any]:
    """The OpenAPI document."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "tagid station",
            "version": __version__,
            "description": "Start a scan, monitor it, read its result, enroll an object, list and export the "
            "history, and write reports over it. "
            f"Each POST needs the header `{OWN_HEADER}: 1`. On an address other than loopback, "
            "each request needs a token, which POST /api/v1/pair creates from the pairing code.",
        },
        "security": [{}, {"bearer": []}, {"cookie": []}],
        "paths": {
            "/api/v1/pair": {
                "post": _post("Create a token from the pairing code", "Pairing", 200, "Token", 429)
            },
            "/api/v1/status": {"get": _get("State of the station", "Status")},
            "/api/v1/scan": {
                "get": _get("The newest scan with its result so far", "Scan", missing=True),
                "post": _post("Start a scan", "Start", 202, "Started"),
            },
            "/api/v1/scan/stop": {"post": _post("Stop the scan and keep its capture", "Empty", 202, "Empty")},
            "/api/v1/scan/residuals": {
                "get": _file("What its hypotheses leave of the echo, a picture", "image/png", missing=True)
            },
            **_history(),
            **_reports(),
            **_enrolment(),
            **_setting_up(),
            **_commissioning(),
        },
        "components": {
            "schemas": _schemas(),
            "securitySchemes": {
                "bearer": {"type": "http", "scheme": "bearer"},
                "cookie": {"type": "apiKey", "in": "cookie", "name": COOKIE},
            },
        },
    }


def _history() -> dict[str, Any]:
    return {
        "/api/v1/history": {"get": {**_get("Identifications, newest first", "History"), **_filters()}},
        "/api/v1/history.csv": {"get": {**_file("The same as a table", "text/csv"), **_filters()}},
        "/api/v1/history.json": {
            "get": {**_file("The same as a JSON file", "application/json"), **_filters()}
        },
        "/api/v1/history/captures.zip": {
            "get": {
                **_file("The captures of the same entries with their table", "application/zip", missing=True),
                **_filters(),
            }
        },
        "/api/v1/history/{number}/picture": {
            "get": {**_file("The picture of an identification", "image/png", missing=True), **_number()}
        },
        "/api/v1/history/{number}/thumbnail": {
            "get": {**_file("The same, small and without axes", "image/png", missing=True), **_number()}
        },
        "/api/v1/history/{number}/residuals": {
            "get": {
                **_file("What its hypotheses leave of the echo, a picture", "image/png", missing=True),
                **_number(),
            }
        },
        "/api/v1/history/{number}/replay": {
            "post": {
                **_post("Show a capture as if it was recorded now", "Keyed", 202, "Started"),
                "parameters": [_OWN, *_number()["parameters"]],
            }
        },
        "/api/v1/history/{number}/capture": {
            "get": {
                **_file("The capture of an identification", "application/x-hdf5", missing=True),
                **_number(),
            }
        },
    }


def _reports() -> dict[str, Any]:
    files = {
        f"/api/v1/reports/{{number}}/{name}": {
            "get": {
                **_file(f"{name} of a complete report", media.partition(";")[0], missing=True),
                **_number(),
            }
        }
        for name, media in MEDIA.items()
    }
    return {
        "/api/v1/reports": {
            "post": _post("Begin a report over entries of the history", "ReportStart", 202, "ReportStarted")
        },
        "/api/v1/reports/stop": {
            "post": _post("Stop the report; finished captures are in it", "Keyed", 202, "Empty")
        },
        "/api/v1/reports/{number}": {
            "get": {**_get("Progress of a report", "Report", missing=True), **_number()}
        },
        **files,
    }


def _enrolment() -> dict[str, Any]:
    place = "/api/v1/enrolment"
    paper = [
        {"name": "paper", "in": "query", "schema": {"enum": list(PAPERS_MM), "default": "a4"}},
        {
            "name": "surface_radius_m",
            "in": "query",
            "schema": {"type": "number"},
            "description": "Radius of the surface that the strip wraps around.",
        },
    ]
    name = _path("name", "string")

    def act(summary: str, asked: str = "Keyed") -> dict[str, Any]:
        return {"post": _post(summary, asked, 200, "Enrolment")}

    return {
        place: {
            "get": _get("State of the enrolment", "Enrolment"),
            **act("Begin an enrollment, or change the name of the current one", "Subject"),
        },
        f"{place}/capture": {
            "post": _post("Start a scan whose capture is added to the enrollment", "Keyed", 202, "Started")
        },
        f"{place}/drop": act("Remove a capture from the enrollment; its file is kept", "Drop"),
        f"{place}/store": act("Enroll the object", "Store"),
        f"{place}/undo": act("Undo the last enrollment of the station"),
        f"{place}/cancel": act("End the enrollment without storing anything"),
        f"{place}/template.pdf": {
            "get": {
                **_file("Template at 1:1 of the measured layout", "application/pdf", missing=True),
                "parameters": paper,
            }
        },
        "/api/v1/layouts": {"get": _get("The enrolled layouts", "Layouts")},
        "/api/v1/layouts/{name}/template.pdf": {
            "get": {
                **_file("Template at 1:1 of an enrolled layout", "application/pdf", missing=True),
                "parameters": [name, *paper],
            }
        },
    }


def _setting_up() -> dict[str, Any]:
    return {
        "/api/v1/settings": {
            "get": _get("The settings of the page, and what the searches found", "Settings"),
            "post": _post("Change settings; all of them, or none", "Changes", 200, "Settings"),
        },
        "/api/v1/settings/find": {
            "post": _post("Search for radars, or robots and tables", "Find", 200, "Settings")
        },
        "/api/v1/profile": {
            "get": _get("The echo over range", "Profile", missing=True),
            "post": _post("Show the echo over range, until a scan begins", "Keyed", 202, "Empty"),
        },
        "/api/v1/profile/stop": {"post": _post("End the range profile", "Empty", 202, "Empty")},
        UPLOAD_PATH: {
            "post": {
                **_post("Store a capture and identify it", "Empty", 202, "Received", 413, 415),
                "parameters": [
                    _OWN,
                    _header(NAME_HEADER, "Percent-encoded name of the file."),
                    _header(KEY_HEADER, "As key in the body of other requests."),
                ],
                "requestBody": {"content": {"application/octet-stream": {}}},
            }
        },
    }


def _commissioning() -> dict[str, Any]:
    return {
        "/api/v1/commissioning": {
            "get": _get("The steps of the commissioning with their results", "Commissioning"),
            "post": _post("Start or repeat a step", "StepStart", 202, "Empty"),
        },
        "/api/v1/commissioning/stop": {
            "post": _post("End the running step; earlier results are kept", "Empty", 202, "Empty")
        },
        "/api/v1/commissioning/page.pdf": {
            "get": _file("The results as a page to be filed", "application/pdf", missing=True)
        },
        "/api/v1/commissioning/{step}/{number}.svg": {
            "get": {
                **_file("A picture of a step, by its number", "image/svg+xml", missing=True),
                "parameters": [_path("step", "string"), _path("number", "integer")],
            },
        },
    }


def _header(name: str, description: str) -> dict[str, Any]:
    return {"name": name, "in": "header", "schema": {"type": "string"}, "description": description}


def _file(summary: str, media: str, missing: bool = False) -> dict[str, Any]:
    responses = {"200": {"description": "The file", "content": {media: {}}}, "401": _error()}
    return {"summary": summary, "responses": {**responses, **({"404": _error()} if missing else {})}}


def _path(name: str, kind: str) -> dict[str, Any]:
    return {"name": name, "in": "path", "required": True, "schema": {"type": kind}}


def _number() -> dict[str, Any]:
    return {"parameters": [_path("number", "integer")]}


def _get(summary: str, schema: str, missing: bool = False) -> dict[str, Any]:
    responses = {"200": _answer(schema), "401": _error()}
    return {"summary": summary, "responses": {**responses, **({"404": _error()} if missing else {})}}


def _post(summary: str, asked: str, status: int, answered: str, *refused: int) -> dict[str, Any]:
    return {
        "summary": summary,
        "parameters": [_OWN],
        "requestBody": {"content": {"application/json": {"schema": _ref(asked)}}},
        "responses": {
            str(status): _answer(answered),
            **{str(code): _error() for code in (400, 401, 403, 409, *refused, 503, 507)},
        },
    }


def _filters() -> dict[str, Any]:
    texts = ("status", "layout", "file", "since", "until")
    parameters: list[dict[str, Any]] = [
        {"name": name, "in": "query", "schema": {"type": "string"}} for name in texts
    ]
    entries = {
        "name": "entries",
        "in": "query",
        "schema": {"type": "string"},
        "description": "Numbers of entries, separated by commas.",
    }
    limit = {"name": "limit", "in": "query", "schema": {"type": "integer"}}
    return {"parameters": [*parameters, limit, entries]}


def _ref(name: str) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{name}"}


def _answer(schema: str) -> dict[str, Any]:
    return {"description": schema, "content": {"application/json": {"schema": _ref(schema)}}}


def _error() -> dict[str, Any]:
    return {"description": "Why not", "content": {"application/json": {"schema": _ref("Error")}}}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": sorted(properties)}


def _or_null(schema: dict[str, Any]) -> dict[str, Any]:
    return {"oneOf": [schema, {"type": "null"}]}


def _schemas() -> dict[str, Any]:
    text, number, whole = {"type": "string"}, {"type": "number"}, {"type": "integer"}
    maybe_number, maybe_text = {"type": ["number", "null"]}, {"type": ["string", "null"]}
    yes_no = {"type": "boolean"}
    key = {
        **text,
        "description": "Key of a WebSocket connection; required if a browser operates the station, or if "
        "the scan moves a device.",
    }
    entry = {name: {"type": [_KINDS[TYPES[name]], "null"]} for name in FIELDS}
    hypothesis = _object(words=text, layout=maybe_text, log_evidence=number, unexplained=number)
    answer = _object(
        status={"enum": list(STATUSES)},
        layout=maybe_text,
        label=text,
        score=number,
        margin=number,
        reason=text,
        reason_code=text,
        advice=text,
        causes={
            "type": "array",
            "items": _object(code=text, text=text, remedy=text, settings={"type": "object"}),
        },
        reflectors={"type": "array", "items": _object(x_m=number, y_m=number, matched=yes_no)},
        lead_needed=maybe_number,
        hypotheses={"type": "array", "items": hypothesis},
        capture_uuid=maybe_text,
    )
    evidence = _object(layout=text, log_evidence=number, lead=number)
    phases = ["connecting", "turning", "reading", "done", "failed"]
    return {
        "Empty": {"type": "object"},
        "Keyed": {"type": "object", "properties": {"key": key}},
        "Drop": {
            "type": "object",
            "properties": {"number": whole, "key": key},
            "required": ["number"],
        },
        "Store": {"type": "object", "properties": {"force": {"type": "boolean"}, "key": key}},
        "Subject": {
            "type": "object",
            "properties": {"name": text, "kind": {"enum": list(KINDS)}, "label": text, "key": key},
            "required": ["name"],
        },
        "ReportStart": {
            "type": "object",
            "properties": {
                "entries": {"type": "array", "items": whole, "minItems": 1, "maxItems": HISTORY_LIMIT},
                "key": key,
            },
            "required": ["entries"],
        },
        "Pairing": _object(code=text),
        "Token": _object(token=text),
        "Start": {
            "type": "object",
            "properties": {
                "note": {**text, "description": "Text stored with the capture."},
                "object": {**text, "description": "Name of an object of a demonstration."},
                "key": key,
            },
        },
        "Started": _object(number=whole),
        "Received": _object(number=whole, file=text),
        **_setting_up_schemas(key),
        **_commissioning_schemas(key),
        "ReportStarted": _object(number=whole, left_out=text),
        "Answer": answer,
        "Scan": _object(
            number=whole,
            running=yes_no,
            moves=yes_no,
            phase={"enum": phases},
            scans=whole,
            lost=whole,
            seconds=number,
            turned_deg=maybe_number,
            turn_share=maybe_number,
            views=whole,
            snr_db=maybe_number,
            silent_s=number,
            note=text,
            remark=text,
            file=text,
            has_residuals=yes_no,
            evidence={"type": "array", "items": evidence},
            answer=_or_null(_ref("Answer")),
            final=yes_no,
            answer_after_last_scan_s=maybe_number,
        ),
        "Status": _object(
            type={"const": "status"},
            demo=yes_no,
            operated=yes_no,
            connections=whole,
            full=yes_no,
            scan=_or_null(_ref("Scan")),
            health=_object(
                checked=yes_no,
                findings={
                    "type": "array",
                    "items": _object(
                        topic=text,
                        level={"enum": ["ok", "warning", "problem"]},
                        text=text,
                        remedy=text,
                        answers={"type": ["boolean", "null"]},
                    ),
                },
                recovered_scan={"type": ["integer", "null"]},
                wiring=_or_null(
                    _object(
                        cable={"enum": ["ethernet", "usb", "uart", "none"]},
                        url=text,
                        steps={"type": "array", "items": text},
                    )
                ),
            ),
            enrolment=_ref("Enrolment"),
            report=_or_null(_ref("Report")),
        ),
        "Report": _object(
            number=whole,
            running=yes_no,
            done=whole,
            total=whole,
            complete=yes_no,
            folder=text,
            left_out=text,
            error=_or_null(_ref("Problem")),
        ),
        "Enrolment": _object(
            subject=_or_null(_object(name=text, kind=text, label=text)),
            needed=whole,
            captures={
                "type": "array",
                "items": _object(
                    number=whole,
                    file=text,
                    reflectors={"type": ["integer", "null"]},
                    status={"enum": list(STATUSES)},
                    layout={"type": ["string", "null"]},
                    error=_or_null(_ref("Problem")),
                ),
            },
            measuring=yes_no,
            trouble=_or_null(_ref("Problem")),
            remarks={"type": "array", "items": text},
            proposal=_or_null(_ref("Proposal")),
            stored=_or_null(_object(name=text, registry_version=whole, has_layout=yes_no)),
            undone=text,
        ),
        "Proposal": _object(
            ready=yes_no,
            reflectors={"type": "array", "items": _object(x_m=number, y_m=number)},
            spread_m={"type": "array", "items": number},
            signature=yes_no,
            confusion_rate=maybe_number,
            reference=_or_null(_object(views=whole, snr_db=number)),
            nearest={
                "type": "array",
                "items": _object(name=text, worst_m=maybe_number, difference=maybe_number, confusable=yes_no),
            },
        ),
        "Layouts": _object(
            items={"type": "array", "items": _object(name=text, kind=text, label=text, size=whole)}
        ),
        "History": _object(
            items={
                "type": "array",
                "items": _object(**entry, has_capture=yes_no, has_picture=yes_no, has_residuals=yes_no),
            }
        ),
        "Problem": _object(code=text, message=text, remedy=text),
        "Error": _object(error=_ref("Problem")),
    }


def _commissioning_schemas(key: dict[str, Any]) -> dict[str, Any]:
    text, number, yes_no = {"type": "string"}, {"type": "number"}, {"type": "boolean"}
    row = _object(name=text, level={"enum": list(Level)}, number=text, text=text, advice=text)
    pictures = {"type": "array", "items": text}
    report = _object(date_utc=text, passed=yes_no, rows={"type": "array", "items": row}, pictures=pictures)
    names = {"enum": [step.name for step in STEPS]}
    tape = {name: {"type": ["number", "null"]} for name in TAPE_NUMBERS} | {"target": text}
    return {
        "StepStart": {
            "type": "object",
            "properties": {"step": names, "tape": {"type": "object", "properties": tape}, "key": key},
            "required": ["step"],
        },
        "StepProgress": _object(
            running=yes_no,
            step={"type": ["string", "null"]},
            share=number,
            remark=text,
            error=_or_null(_ref("Problem")),
        ),
        "Commissioning": _object(
            steps={
                "type": "array",
                "items": _object(name=names, title=text, prepare=text, report=_or_null(report)),
            },
            next=names,
            tape=_object(**tape),
            profile={"type": ["string", "null"]},
            progress=_ref("StepProgress"),
        ),
    }


def _setting_up_schemas(key: dict[str, Any]) -> dict[str, Any]:
    text, number = {"type": "string"}, {"type": "number"}
    pair = {"type": ["array", "null"], "items": number, "minItems": 2, "maxItems": 2}
    search = _object(
        devices={"type": "array", "items": _object(url=text, text=text, problem=text)},
        note=text,
    )
    value = {"type": ["string", "number", "null"]}
    return {
        "Changes": {
            "type": "object",
            "properties": {
                "changes": {"type": "object", "properties": dict.fromkeys(NAMES, value)},
                "key": key,
            },
            "required": ["changes"],
        },
        "Find": {
            "type": "object",
            "properties": {"kind": {"enum": list(DEVICE_KINDS)}, "key": key},
            "required": ["kind"],
        },
        "Settings": _object(
            items={
                "type": "array",
                "items": _object(name={"enum": list(NAMES)}, value=value, fixed=text),
            },
            found=_object(**dict.fromkeys(DEVICE_KINDS, _or_null(search))),
        ),
        "Profile": _object(
            running={"type": "boolean"},
            range_m=pair,
            echo_db={"type": "array", "items": number},
            moving_db={"type": "array", "items": number},
            axis_m={"type": ["number", "null"]},
            object_m=pair,
            scans={"type": "integer"},
            error=_or_null(_ref("Problem")),
        ),
    }
