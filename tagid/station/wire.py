"""The station's values as JSON: states, answers, health, history. Pixels are levels in base64."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid._version import __version__
from tagid.commissioning.bench import Bench
from tagid.commissioning.rows import Level, StepReport
from tagid.commissioning.steps import STEPS, next_step
from tagid.config import data_folder
from tagid.errors import TagidError
from tagid.live.state import LiveState
from tagid.pipeline.answer import Identification
from tagid.pipeline.enrollment import LayoutProposal, Measured, SignatureProposal
from tagid.report.colours import to_decibels, viridis
from tagid.report.preview import resample
from tagid.result import Problem, reworded, reworded_document
from tagid.rig import installed_profile
from tagid.station.commissioning import CommissioningRun, StepProgress
from tagid.station.enrolling import NEEDED, EnrolmentState, Taken
from tagid.station.profile import ProfileRun
from tagid.station.reports import ReportRun
from tagid.station.scans import Run
from tagid.station.settings import DEVICE_KINDS, shown_settings
from tagid.station.station import MAX_CONNECTIONS, Health, Station

IMAGE_DB = 25.0
SINOGRAM_DB = 30.0
_SINOGRAM_ROWS, _SINOGRAM_COLUMNS = 120, 128
_NEAREST = 6
"""Neighbours of a new layout that are shown."""

_CONTROLS = {
    "axis_distance": "“Axis distance”",
    "distance": "“Target distance”",
    "force": "the button “Enroll it anyway”",
    "paper": "“Paper”",
    "since": "“Since”",
    "until_sure": "“End a scan as soon as the answer is certain”",
}
"""What the page offers for an argument that a remedy names."""

Json = dict[str, Any]


def status(station: Station) -> Json:
    """State of the station, without pixels."""
    run = station.scan
    return {
        "type": "status",
        "demo": bool(station.source.demo),
        "operated": station.operators.taken,
        "connections": station.operators.connected,
        "full": station.operators.connected >= MAX_CONNECTIONS,
        "scan": None if run is None else scan(run),
        "health": health(station.health),
        "enrolment": enrolment(station.enrolling.state),
        "report": None if station.reports.newest is None else report(station.reports.newest),
    }


def hello(station: Station, key: str) -> Json:
    """What a new connection learns first: its key, and what does not change."""
    objects = [{"name": item.name, "words": item.words} for item in station.source.demo]
    return {
        "type": "hello",
        "key": key,
        "version": __version__,
        "palette": base64.b64encode(viridis(256).tobytes()).decode(),
        "demo": bool(station.source.demo),
        "objects": objects,
    }


def scan(run: Run) -> Json:
    state = run.view.state
    return {
        "number": run.number,
        "running": run.running,
        "moves": run.motion.moves,
        "phase": state.phase.value,
        "scans": state.scans,
        "lost": state.lost,
        "seconds": round(state.seconds, 2),
        "turned_deg": None if state.turned_rad is None else round(math.degrees(state.turned_rad), 1),
        "turn_share": state.turn_share,
        "views": state.views,
        "snr_db": None if state.snr_db is None else round(state.snr_db, 1),
        "silent_s": round(run.view.silent_s, 1),
        "note": state.note,
        "remark": run.remark,
        "file": run.file,
        "has_residuals": run.residuals is not None,
        "evidence": [
            {"layout": item.layout, "log_evidence": round(item.log_evidence, 1), "lead": round(item.lead, 1)}
            for item in state.evidence
        ],
        "answer": None if state.answer is None else answer(state.answer),
        "final": state.final,
        "answer_after_last_scan_s": state.answer_after_s,
    }


def answer(identification: Identification) -> Json:
    """Fields of an answer for the page and scripts; `tagid identify` has all fields."""
    values = identification.to_dict()
    names = ("status", "layout", "label", "score", "margin", "reason", "reason_code", "advice", "causes")
    reflectors = [{key: row[key] for key in ("x_m", "y_m", "matched")} for row in values["reflectors"]]
    shown = "words", "layout", "log_evidence", "unexplained"
    hypotheses = [{key: row[key] for key in shown} for row in values["hypotheses"]]
    fields = {name: values[name] for name in (*names, "lead_needed", "capture_uuid")}
    return {**fields, "reflectors": reflectors, "hypotheses": hypotheses}


def pictures(state: LiveState) -> Json:
    """Image and sinogram as levels 0..255, row by row from the top; null if there is none."""
    image, sinogram = None, None
    if state.image is not None:
        pixels = _levels(np.abs(state.image.values[::-1]), IMAGE_DB)
        image = {
            "side": len(pixels),
            "extent_m": state.image.grid.extent,
            "centre_m": list(state.image.centre_m),
            "depth_db": IMAGE_DB,
            "levels": _packed(pixels),
        }
    if state.sinogram is not None:
        rows = state.sinogram.rows.astype(np.float64)
        shown = resample(rows, min(_SINOGRAM_ROWS, len(rows)), min(_SINOGRAM_COLUMNS, rows.shape[1]))
        pixels = _levels(shown, SINOGRAM_DB)
        sinogram = {
            "rows": len(pixels),
            "columns": pixels.shape[1],
            "range_m": [round(value, 3) for value in state.sinogram.range_m],
            "depth_db": SINOGRAM_DB,
            "levels": _packed(pixels),
        }
    return {"image": image, "sinogram": sinogram}


def frame(run: Run) -> Json:
    """A scan's state with its pictures, as sent to the page several times per second."""
    return {"type": "frame", "scan": scan(run), **pictures(run.view.state)}


def profile(run: ProfileRun) -> Json:
    shown = run.profile
    return {
        "running": run.running,
        "range_m": list(shown.range_m),
        "echo_db": np.round(shown.echo_db, 1).tolist(),
        "moving_db": np.round(shown.moving_db, 1).tolist(),
        "axis_m": shown.axis_m,
        "object_m": None if shown.object_m is None else list(shown.object_m),
        "scans": shown.scans,
        "error": error_entry(shown.error),
    }


def step_progress(run: CommissioningRun | None) -> Json:
    shown = StepProgress(None) if run is None else run.progress
    return {
        "running": run is not None and run.running,
        "step": shown.step,
        "share": round(shown.share, 3),
        "remark": shown.remark,
        "error": error_entry(shown.error),
    }


def commissioning(station: Station) -> Json:
    """All steps of the commissioning. Raises ConfigError, StorageError."""
    bench = Bench(station.source.place().config, {})
    reports, profile = bench.reports(), installed_profile(data_folder())
    return {
        "steps": [
            {
                "name": step.name,
                "title": step.title,
                "prepare": step.prepare,
                "report": _step_report(reports.get(step.name)),
            }
            for step in STEPS
        ],
        "next": next_step(bench).name,
        "tape": asdict(bench.tape),
        "profile": None if profile is None else profile.day,
        "progress": step_progress(station.commissioning),
    }


def _step_report(report: StepReport | None) -> Json | None:
    if report is None:
        return None
    rows = [
        {
            "name": row.name,
            "level": row.level.value,
            "number": row.number,
            "text": row.text,
            "advice": "" if row.level is Level.PASS else row.advice,
        }
        for row in report.rows
    ]
    pictures = [picture.title for picture in report.pictures]
    return {"date_utc": report.date_utc, "passed": report.passed, "rows": rows, "pictures": pictures}


def settings(station: Station) -> Json:
    """The settings of the page, and what the last searches found. Raises ConfigError, StorageError."""
    searches = station.settings.searches
    return {
        "items": [asdict(setting) for setting in shown_settings(station.source.place().config)],
        "found": {kind: asdict(searches[kind]) if kind in searches else None for kind in DEVICE_KINDS},
    }


def health(state: Health) -> Json:
    return {
        "checked": state.checked_at is not None,
        "findings": [asdict(finding) for finding in state.findings],
        "recovered_scan": state.recovered,
        "wiring": None if state.wiring is None else asdict(state.wiring),
    }


def enrolment(state: EnrolmentState) -> Json:
    return {
        "subject": None if state.subject is None else asdict(state.subject),
        "needed": NEEDED,
        "captures": [_taken(capture) for capture in state.captures],
        "measuring": state.measuring,
        "trouble": error_entry(state.trouble),
        "remarks": _remarks(state),
        "proposal": None if state.proposal is None else proposal(state.proposal, state.measured),
        "stored": None if state.stored is None else asdict(state.stored),
        "undone": state.undone,
    }


def _remarks(state: EnrolmentState) -> list[str]:
    """Remarks on the captures so far; what only more captures give is not missing yet."""
    if state.measured is None:
        return []
    enough = len(state.captures) >= NEEDED
    return list(state.measured.remarks if enough else state.measured.unmoved)


def _taken(taken: Taken) -> Json:
    reading = taken.answer.reading
    return {
        "number": taken.number,
        "file": taken.path.name,
        "reflectors": None if taken.sighted is None else len(taken.sighted.sighting.positions),
        "status": taken.answer.status,
        "layout": None if reading is None else reading.layout,
        "error": error_entry(taken.error),
    }


def proposal(proposed: LayoutProposal | SignatureProposal, measured: Measured | None) -> Json:
    """What an enrollment would store, compared with its neighbours."""
    shown: Json = {
        "ready": proposed.taken is None and proposed.conflict is None,
        "reflectors": [],
        "spread_m": [],
        "signature": True,
        "confusion_rate": None,
        "reference": None,
    }
    nearest: list[tuple[str, float | None, float | None, bool]]
    if isinstance(proposed, SignatureProposal):
        nearest = [(item.second, None, item.difference, item.alike) for item in proposed.likenesses]
    else:
        estimate = None if measured is None else measured.estimate
        outlook, conditions = proposed.outlook, proposed.outlook.conditions
        shown |= {
            "reflectors": [{"x_m": float(x), "y_m": float(y)} for x, y in proposed.layout.positions],
            "spread_m": [] if estimate is None else [float(value) for value in estimate.spread_m],
            "signature": proposed.signature is not None,
            "confusion_rate": outlook.unresolved,
            "reference": {"views": conditions.views, "snr_db": conditions.snr_db},
        }
        nearest = [(item.name, item.distance.worst_m, None, item.confusable) for item in outlook.neighbours]
    names = ("name", "worst_m", "difference", "confusable")
    return {**shown, "nearest": [dict(zip(names, item, strict=True)) for item in nearest[:_NEAREST]]}


def report(run: ReportRun) -> Json:
    return {
        "number": run.number,
        "running": run.running,
        "done": run.done,
        "total": run.total,
        "complete": run.complete,
        "folder": str(run.folder),
        "left_out": run.left_out,
        "error": error_entry(run.error),
    }


def error_entry(error: TagidError | None) -> Json | None:
    """An error: code, message and remedy; null if there is none."""
    return None if error is None else Problem.of(error).to_json()


def to_text(value: Json) -> str:
    """JSON text; numbers that are not finite become null."""
    document = reworded_document(_finite(value), in_page_words)
    return json.dumps(document, allow_nan=False, separators=(",", ":"))


def in_page_words(text: str) -> str:
    """Text that names the page's controls instead of arguments; settings stay, the page has none."""
    return reworded(text, lambda name, _: _CONTROLS.get(name))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _levels(magnitude: NDArray[np.floating], depth_db: float) -> NDArray[np.uint8]:
    decibels = to_decibels(magnitude, depth_db)
    return np.asarray(np.rint((decibels / depth_db + 1) * 255), dtype=np.uint8)


def _packed(levels: NDArray[np.uint8]) -> str:
    return base64.b64encode(levels.tobytes()).decode()
