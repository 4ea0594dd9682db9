"""The description of the JSON API, OpenAPI 3.1."""

from __future__ import annotations

from typing import Any

from tagid import __version__
from tagid.station.security import COOKIE, OWN_HEADER
from tagid.storage.history import FIELDS, STATUSES, TYPES

_KINDS = {str: "string", int: "integer", float: "number"}


def document() -> dict[str, Any]:
    """The OpenAPI document."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "tagid station",
            "version": __version__,
            "description": "Start a scan, monitor it, read its result, and list the history. "
            f"Each POST needs the header `{OWN_HEADER}: 1`. On an address other than loopback, "
            "each request needs a token, which POST /api/v1/pair creates from the pairing code.",
        },
        "security": [{}, {"bearer": []}, {"cookie": []}],
        "paths": {
            "/api/v1/pair": {"post": _post("Create a token from the pairing code", "Pairing", 200, "Token")},
            "/api/v1/status": {"get": _get("State of the station", "Status")},
            "/api/v1/scan": {
                "get": _get("The newest scan with its result so far", "Scan", missing=True),
                "post": _post("Start a scan", "Start", 202, "Started"),
            },
            "/api/v1/scan/stop": {"post": _post("Stop the scan and keep its capture", "Empty", 202, "Empty")},
            "/api/v1/history": {"get": {**_get("Identifications, newest first", "History"), **_filters()}},
            "/api/v1/history.csv": {
                "get": {
                    "summary": "The same as a table",
                    **_filters(),
                    "responses": {"200": {"description": "CSV", "content": {"text/csv": {}}}},
                }
            },
            "/api/v1/history/{number}/picture": {
                "get": {
                    "summary": "The picture of an identification",
                    "parameters": [
                        {"name": "number", "in": "path", "required": True, "schema": {"type": "integer"}}
                    ],
                    "responses": {
                        "200": {"description": "PNG", "content": {"image/png": {}}},
                        "404": _error(),
                    },
                }
            },
        },
        "components": {
            "schemas": _schemas(),
            "securitySchemes": {
                "bearer": {"type": "http", "scheme": "bearer"},
                "cookie": {"type": "apiKey", "in": "cookie", "name": COOKIE},
            },
        },
    }


def _get(summary: str, schema: str, missing: bool = False) -> dict[str, Any]:
    responses = {"200": _answer(schema), "401": _error()}
    return {"summary": summary, "responses": {**responses, **({"404": _error()} if missing else {})}}


def _post(summary: str, asked: str, status: int, answered: str) -> dict[str, Any]:
    return {
        "summary": summary,
        "parameters": [
            {"name": OWN_HEADER, "in": "header", "required": True, "schema": {"type": "string", "const": "1"}}
        ],
        "requestBody": {"content": {"application/json": {"schema": _ref(asked)}}},
        "responses": {
            str(status): _answer(answered),
            **{str(code): _error() for code in (400, 401, 403, 409, 503, 507)},
        },
    }


def _filters() -> dict[str, Any]:
    texts = ("status", "layout", "file", "since", "until")
    parameters: list[dict[str, Any]] = [
        {"name": name, "in": "query", "schema": {"type": "string"}} for name in texts
    ]
    return {"parameters": [*parameters, {"name": "limit", "in": "query", "schema": {"type": "integer"}}]}


def _ref(name: str) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{name}"}


def _answer(schema: str) -> dict[str, Any]:
    return {"description": schema, "content": {"application/json": {"schema": _ref(schema)}}}


def _error() -> dict[str, Any]:
    return {"description": "Why not", "content": {"application/json": {"schema": _ref("Error")}}}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": sorted(properties)}


def _schemas() -> dict[str, Any]:
    text, number, whole = {"type": "string"}, {"type": "number"}, {"type": "integer"}
    maybe_number = {"type": ["number", "null"]}
    yes_no = {"type": "boolean"}
    entry = {name: {"type": [_KINDS[TYPES[name]], "null"]} for name in FIELDS}
    answer = _object(
        status={"enum": list(STATUSES)},
        layout={"type": ["string", "null"]},
        label=text,
        score=number,
        margin=number,
        reason=text,
        reason_code=text,
        advice=text,
        capture_uuid={"type": ["string", "null"]},
    )
    evidence = _object(
        layout=text, share=number, needed_share=number, nats=number, needed_nats=number, enough=yes_no
    )
    phases = ["connecting", "turning", "reading", "done", "failed"]
    return {
        "Empty": {"type": "object"},
        "Pairing": _object(code=text),
        "Token": _object(token=text),
        "Start": {
            "type": "object",
            "properties": {
                "note": {**text, "description": "Text stored with the capture."},
                "key": {
                    **text,
                    "description": "Key of a WebSocket connection; required if the scan moves a device.",
                },
            },
        },
        "Started": _object(number=whole),
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
            evidence={"type": "array", "items": evidence},
            answer={"oneOf": [_ref("Answer"), {"type": "null"}]},
            final=yes_no,
            answer_after_last_scan_s=maybe_number,
        ),
        "Status": _object(
            type={"const": "status"},
            demo=yes_no,
            operated=yes_no,
            connections=whole,
            scan={"oneOf": [_ref("Scan"), {"type": "null"}]},
            health=_object(
                checked=yes_no,
                findings={
                    "type": "array",
                    "items": _object(
                        topic=text, level={"enum": ["ok", "warning", "problem"]}, text=text, remedy=text
                    ),
                },
            ),
        ),
        "History": _object(items={"type": "array", "items": _object(**entry)}),
        "Error": _object(error=_object(code=text, message=text, remedy=text)),
    }
