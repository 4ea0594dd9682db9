"""The answer to "what is this object" as a value with the fields of the JSON contract.

Commands, batch runs and the history share it, so that its JSON form is defined once.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from math import isfinite
from typing import TYPE_CHECKING, Any

from tagid._version import __version__
from tagid.result import Problem

if TYPE_CHECKING:
    from tagid.reading.reading import Reading


@dataclass(frozen=True)
class Cause:
    """A likely cause of a failed identification.

    Attributes:
        code: "speed", "turn_stopped", "scans_lost", "partial_turn", "axis_distance" or "off_centre"; stable,
            for programs.
        text: what the scans show.
        remedy: what to do.
        settings: with which the recording is read rightly, by name; empty if no setting cures it.
    """

    code: str
    text: str
    remedy: str
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Identification:
    """The answer to "what is this object" (contract: Identification).

    Attributes:
        reading: result of reading the scans; None if status is "failed".
        status: "identified", "unknown", "ambiguous", "no_tag" or "failed".
        capture_uuid, registry_version, label: provenance and readable name.
        seconds: seconds per stage.
        error: what failed if status is "failed".
        causes: likely causes if nothing is named, most certain first.
        advice: what to do next, if the recording calls for something else than the reading's advice.
        coverage: share of a turn from which the object was seen, 0 to 1; None if unknown.
        remarks: on the recording, one sentence each: how its file was read, its samples, speed and losses.
    """

    status: str
    reading: Reading | None
    capture_uuid: str | None
    registry_version: int | None
    label: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    error: Problem | None = None
    causes: tuple[Cause, ...] = ()
    advice: str = ""
    coverage: float | None = None
    remarks: tuple[str, ...] = ()

    def what_to_do(self) -> str:
        """What to do next besides the remedies of the causes; "" if the object is named."""
        if self.reading is None:
            return self.error.remedy if self.error else ""
        return self.advice or self.reading.advice

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values, with all fields of the contract."""
        r = self.reading
        error = self.error or Problem("", "")
        scores = r.scores if r else ()
        shares = {score.name: score.share for score in scores}
        return {
            "status": self.status,
            "reason": r.reason if r else error.message,
            "reason_code": r.code.value if r else error.code,
            "advice": self.what_to_do(),
            "causes": [asdict(cause) for cause in self.causes],
            "nearest": {"layout": r.nearest, "share": shares.get(r.nearest)} if r else None,
            "layout": r.layout if r else None,
            "label": self.label,
            "score": r.score if r else 0.0,
            "margin": r.margin if r else 0.0,
            "lead": r.lead if r else None,
            "lead_needed": (r.needed if isfinite(r.needed) else None) if r else None,
            "rotation_deg": r.rotation_deg if r and r.layout else None,
            "centre_m": list(r.centre_m) if r and r.layout else None,
            "reflectors": self._reflectors(),
            "missing": r.missing if r else 0,
            "extra": r.extra if r else 0,
            "scores": [{"layout": s.name, "criterion": s.criterion, "share": s.share} for s in scores],
            "hypothesis": r.kind.value if r else None,
            "hypotheses": self._hypotheses(),
            "bound": self._bound(),
            "coverage": None if self.coverage is None else round(self.coverage, 3),
            "note": r.note if r else "",
            "remarks": list(self.remarks),
            "capture_uuid": self.capture_uuid,
            "tool_version": __version__,
            "registry_version": self.registry_version,
            "seconds": {name: round(value, 4) for name, value in self.seconds.items()},
            "error": self.error and self.error.to_json(),
        }

    def _bound(self) -> dict[str, Any] | None:
        """Basis of the false-accept bound; None if no calibration applies."""
        bound = self.reading.bound if self.reading else None
        if bound is None or bound.objects == 0:
            return None
        return {
            "p_value": bound.p_value,
            "false_accept": bound.false_accept,
            "calibration_objects": bound.objects,
            "stratum": bound.stratum,
            "population": bound.population,
        }

    def _hypotheses(self) -> list[dict[str, Any]]:
        """The best hypothesis of every kind, with its log evidence and its residual."""
        return [
            {
                "kind": hypothesis.kind.value,
                "name": hypothesis.name,
                "layout": hypothesis.layout,
                "words": hypothesis.words,
                "log_evidence": hypothesis.log_evidence,
                "unexplained": hypothesis.unexplained,
                "centre_m": list(hypothesis.centre_m),
                "radius_m": hypothesis.radius_m,
                "outline_m": [list(corner) for corner in hypothesis.outline_m],
            }
            for hypothesis in (self.reading.hypotheses if self.reading else ())
        ]

    def _reflectors(self) -> list[dict[str, Any]]:
        return [
            {
                "x_m": p.x_m,
                "y_m": p.y_m,
                **({} if p.z_m is None else {"z_m": p.z_m}),
                "amplitude_db": p.amplitude_db,
                "matched": p.matched,
            }
            for p in (self.reading.reflectors if self.reading else ())
        ]
