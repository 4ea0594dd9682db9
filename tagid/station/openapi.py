"""The description of the JSON API, OpenAPI 3.1: its operations, and the schemas of what is sent.

msgspec would write the schemas from classes, for 696 KB and 11 ms at every start; the answers, which are
dictionaries, would have to become their instances first.
"""

from __future__ import annotations

import re
from typing import Any

from tagid._version import __version__
from tagid.commissioning.rows import Level
from tagid.commissioning.steps import STEPS
from tagid.live.state import Phase
from tagid.station import web_enrollment, web_history, web_scans, web_settings
from tagid.station.commissioning import TAPE_NUMBERS
from tagid.station.requests import Operation
from tagid.station.security import COOKIE, OWN_HEADER
from tagid.station.settings import DEVICE_KINDS, NAMES
from tagid.station.station import HISTORY_LIMIT
from tagid.storage.history import FIELDS, STATUSES, TYPES
from tagid.tags.layouts.layout import KINDS

Json = dict[str, Any]
OPERATIONS = (*web_scans.API, *web_history.API, *web_enrollment.API, *web_settings.API)
_OWN = {"name": OWN_HEADER, "in": "header", "required": True, "schema": {"type": "string", "const": "1"}}
_TAPE = {name: {"type": ["number", "null"]} for name in TAPE_NUMBERS} | {"target": {"type": "string"}}
_VALUE = {"type": ["string", "number", "null"]}
_PATH_TYPES = {"number": {"type": "integer"}, "name": {"type": "string"}, "step": {"type": "string"}}
_ENTRY = " ".join(f"{name}:{({str: 'text', int: 'whole', float: 'number'})[TYPES[name]]}?" for name in FIELDS)

_TYPES: dict[str, Json] = {
    "text": {"type": "string"},
    "number": {"type": "number"},
    "whole": {"type": "integer"},
    "flag": {"type": "boolean"},
    "object": {"type": "object"},
    "value": _VALUE,
    "changes": {"type": "object", "properties": dict.fromkeys(NAMES, _VALUE)},
    "tape": {"type": "object", "properties": _TAPE},
    "pair": {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2},
    "entries": {"type": "array", "items": {"type": "integer"}, "minItems": 1, "maxItems": HISTORY_LIMIT},
    "key": {
        "type": "string",
        "description": "Key of a WebSocket connection; required if a browser operates the station, or if "
        "the scan moves a device.",
    },
    "note": {"type": "string", "description": "Text stored with the capture."},
    "demo_object": {"type": "string", "description": "Name of an object of a demonstration."},
    "this": {"const": "status"},
    "status": {"enum": list(STATUSES)},
    "phase": {"enum": list(Phase)},
    "kind": {"enum": list(KINDS)},
    "devices": {"enum": list(DEVICE_KINDS)},
    "setting": {"enum": list(NAMES)},
    "step": {"enum": [step.name for step in STEPS]},
    "level": {"enum": list(Level)},
    "finding": {"enum": ["ok", "warning", "problem"]},
    "cable": {"enum": ["ethernet", "usb", "uart", "none"]},
}


def document() -> Json:
    paths: dict[str, Json] = {}
    for operation in OPERATIONS:
        path = re.sub(r":\w+}", "}", operation.path)
        paths.setdefault(path, {})[operation.method.lower()] = _described(operation)
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
        "paths": paths,
        "components": {
            "schemas": _schemas(),
            "securitySchemes": {
                "bearer": {"type": "http", "scheme": "bearer"},
                "cookie": {"type": "apiKey", "in": "cookie", "name": COOKIE},
            },
        },
    }


def _described(operation: Operation) -> Json:
    named = re.findall(r"{(\w+)", operation.path)
    parameters = [
        *([_OWN] if operation.asked else []),
        *({"name": name, "in": "path", "required": True, "schema": _PATH_TYPES[name]} for name in named),
        *operation.parameters,
    ]
    words = "The file" if "/" in operation.answer else operation.answer
    answer = {"description": words, "content": _content(operation.answer)}
    refusal = {"description": "Why not", "content": _content("Error")}
    return {
        "summary": operation.summary,
        **({"parameters": parameters} if parameters else {}),
        **({"requestBody": {"content": _content(operation.asked)}} if operation.asked else {}),
        "responses": {str(operation.status): answer, **dict.fromkeys(map(str, operation.refused), refusal)},
    }


def _content(schema: str) -> Json:
    """Content of a schema, or of a media type."""
    return {schema: {}} if "/" in schema else {"application/json": {"schema": _type(schema)}}


def _type(word: str) -> Json:
    """Schema of a word: of `_TYPES`, or the name of a schema; [] makes an array of it, ? lets it be null."""
    if word.endswith("?"):
        schema = _type(word[:-1])
        kind = schema.get("type", "object")
        return _or_null(schema) if kind == "object" else {**schema, "type": [kind, "null"]}
    if word.endswith("[]"):
        return _array(_type(word[:-2]))
    return {"$ref": f"#/components/schemas/{word}"} if word[0].isupper() else _TYPES[word]


def _members(fields: str) -> Json:
    return {name: _type(word) for name, word in (field.split(":") for field in fields.split())}


def _object(fields: str, **nested: Json) -> Json:
    """An object with all of its members: those in words, `name:type`, and those with schemas of their own."""
    members = _members(fields) | nested
    return {"type": "object", "properties": members, "required": sorted(members)}


def _asked(required: str, optional: str = "") -> Json:
    """The body of a request, with the operator's key and other members that it may lack."""
    needed = {"required": [*_members(required)]} if required else {}
    return {"type": "object", "properties": _members(f"{required} {optional} key:key"), **needed}


def _array(schema: Json) -> Json:
    return {"type": "array", "items": schema}


def _or_null(schema: Json) -> Json:
    return {"oneOf": [schema, {"type": "null"}]}


def _schemas() -> Json:
    row = _object("name:text level:level number:text text:text advice:text")
    report = _object("date_utc:text passed:flag pictures:text[]", rows=_array(row))
    step = _object("name:step title:text prepare:text", report=_or_null(report))
    device = _object("url:text text:text problem:text")
    search = _object("note:text", devices=_array(device))
    finding = _object("topic:text level:finding text:text remedy:text answers:flag?")
    return {
        "Empty": {"type": "object"},
        "Keyed": _asked(""),
        "Drop": _asked("number:whole"),
        "Store": _asked("", "force:flag"),
        "Subject": _asked("name:text", "kind:kind label:text"),
        "ReportStart": _asked("entries:entries"),
        "Pairing": _object("code:text"),
        "Token": _object("token:text"),
        "Start": _asked("", "note:note object:demo_object"),
        "Started": _object("number:whole"),
        "Received": _object("number:whole file:text"),
        "Changes": _asked("changes:changes"),
        "Find": _asked("kind:devices"),
        "Settings": _object(
            "",
            items=_array(_object("name:setting value:value fixed:text")),
            found=_object("", **dict.fromkeys(DEVICE_KINDS, _or_null(search))),
        ),
        "Profile": _object(
            "running:flag range_m:pair? echo_db:number[] moving_db:number[] axis_m:number? object_m:pair? "
            "scans:whole error:Problem?"
        ),
        "StepStart": _asked("step:step", "tape:tape"),
        "StepProgress": _object("running:flag step:text? share:number remark:text error:Problem?"),
        "Commissioning": _object(
            "next:step profile:text? progress:StepProgress", steps=_array(step), tape=_object("", **_TAPE)
        ),
        "ReportStarted": _object("number:whole left_out:text"),
        "Answer": _object(
            "status:status layout:text? label:text score:number margin:number reason:text reason_code:text "
            "advice:text lead_needed:number? capture_uuid:text?",
            causes=_array(_object("code:text text:text remedy:text settings:object")),
            reflectors=_array(_object("x_m:number y_m:number matched:flag")),
            hypotheses=_array(_object("words:text layout:text? log_evidence:number unexplained:number")),
        ),
        "Scan": _object(
            "number:whole running:flag moves:flag phase:phase scans:whole lost:whole seconds:number "
            "turned_deg:number? turn_share:number? views:whole snr_db:number? silent_s:number note:text "
            "remark:text file:text has_residuals:flag answer:Answer? final:flag "
            "answer_after_last_scan_s:number?",
            evidence=_array(_object("layout:text log_evidence:number lead:number")),
        ),
        "Status": _object(
            "type:this demo:flag operated:flag connections:whole full:flag scan:Scan? enrolment:Enrolment "
            "report:Report?",
            health=_object(
                "checked:flag recovered_scan:whole?",
                findings=_array(finding),
                wiring=_or_null(_object("cable:cable url:text steps:text[]")),
            ),
        ),
        "Report": _object(
            "number:whole running:flag done:whole total:whole complete:flag folder:text left_out:text "
            "error:Problem?"
        ),
        "Enrolment": _object(
            "needed:whole measuring:flag trouble:Problem? remarks:text[] proposal:Proposal? undone:text",
            subject=_or_null(_object("name:text kind:text label:text")),
            captures=_array(
                _object("number:whole file:text reflectors:whole? status:status layout:text? error:Problem?")
            ),
            stored=_or_null(_object("name:text registry_version:whole has_layout:flag")),
        ),
        "Proposal": _object(
            "ready:flag spread_m:number[] signature:flag confusion_rate:number?",
            reflectors=_array(_object("x_m:number y_m:number")),
            reference=_or_null(_object("views:whole snr_db:number")),
            nearest=_array(_object("name:text worst_m:number? difference:number? confusable:flag")),
        ),
        "Layouts": _object("", items=_array(_object("name:text kind:text label:text size:whole"))),
        "History": _object(
            "", items=_array(_object(f"{_ENTRY} has_capture:flag has_picture:flag has_residuals:flag"))
        ),
        "Problem": _object("code:text message:text remedy:text"),
        "Error": _object("error:Problem"),
    }
