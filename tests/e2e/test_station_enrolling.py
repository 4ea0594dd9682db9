"""Enrolling at the station over its sockets: three scans of an emulated object, its name, undo, the lock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from station_harness import OWN, PLACES, Asks, ended, joined, own_object, poses, wait

from tagid.config import data_folder
from tagid.enrolling.registry import Registry
from tagid.station.server import Server
from tagid.tags.layouts.codebook import best_pairing
from tagid.tags.layouts.layout import Layout


def state(station: Server) -> dict[str, Any]:
    return Asks(station.url, OWN).get("/api/v1/enrolment").json()


def record(station: Server) -> dict[str, Any]:
    """One more capture; the state after it was measured."""
    answer = Asks(station.url, OWN).post("/api/v1/enrolment/capture")
    assert answer.status == 202, answer.text
    scan = ended(station)
    assert scan["phase"] == "done", scan["note"]
    return state(station)


def test_an_object_is_measured_stored_named_and_undone(serve, tmp_path: Path) -> None:
    radars = poses("mine", own_object(tmp_path))
    station = serve(lambda: next(radars))
    client = Asks(station.url, OWN)
    assert client.post("/api/v1/enrolment/capture").json()["error"]["code"] == "enrolment"
    assert client.post("/api/v1/enrolment", name="Mine!").status == 400
    assert client.post("/api/v1/enrolment", name="helmet-120").json()["error"]["code"] == "registry"
    assert client.post("/api/v1/enrolment", name="x", label="=1+1").status == 400
    assert client.post("/api/v1/enrolment", name="gate-4", kind="helmet").status == 200
    for number in (1, 2):
        recorded = record(station)
        assert [taken["reflectors"] for taken in recorded["captures"]] == [3] * number
        assert recorded["trouble"] is None and recorded["proposal"] is None
    assert client.post("/api/v1/enrolment/store").status == 409, "two captures are too few"
    recorded = record(station)
    assert (recorded["measuring"], recorded["trouble"]) == (False, None)
    assert not any("same place" in remark for remark in recorded["remarks"])
    proposal = recorded["proposal"]
    assert proposal["ready"] and not proposal["nearest"][0]["confusable"]
    measured = np.array([(p["x_m"], p["y_m"]) for p in proposal["reflectors"]])
    assert best_pairing(measured, PLACES).worst_m < 2e-3
    assert client.get("/api/v1/enrolment/template.pdf?paper=a3").content.startswith(b"%PDF")
    assert client.get("/api/v1/enrolment/template.pdf?paper=../../etc").status == 400
    # A conflict is told in the words of the page, and only a flag overrides it.
    registry = Registry(data_folder() / "registry.sqlite")
    registry.add(Layout("twin", PLACES), "another program")
    trouble = client.post("/api/v1/enrolment", name="gate-4", kind="helmet").json()["trouble"]
    refused = client.post("/api/v1/enrolment/store")
    for error in (trouble, refused.json()["error"]):
        assert error["code"] == "layout_conflict" and "force" not in error["remedy"]
        assert "the button “Enroll it anyway”" in error["remedy"]
    assert client.post("/api/v1/enrolment/store", force="yes").status == 400
    registry.remove("twin")
    # A new name keeps the captures.
    assert client.post("/api/v1/enrolment", name="gate-5", kind="helmet").json()["proposal"]["ready"]
    stored = client.post("/api/v1/enrolment/store").json()["stored"]
    assert stored["name"] == "gate-5" and stored["has_layout"]
    assert "gate-5" in [layout["name"] for layout in client.get("/api/v1/layouts").json()["items"]]
    assert registry.get("gate-5").kind == "helmet" and registry.version == stored["registry_version"]
    assert client.get("/api/v1/layouts/gate-5/template.pdf").content.startswith(b"%PDF")
    assert client.get("/api/v1/layouts/..%2fgate-5/template.pdf").status == 404
    # The next scan of the object shows its name.
    client.post("/api/v1/scan")
    assert ended(station)["answer"]["layout"] == "gate-5"
    assert client.post("/api/v1/enrolment/undo").json()["undone"] == "gate-5"
    assert "gate-5" not in [layout.name for layout in registry.layouts()]
    assert client.post("/api/v1/enrolment/undo").json()["error"]["code"] == "enrolment"
    notes = [row["file"] for row in client.get("/api/v1/history").json()["items"]]
    assert len(notes) == 4 and all(Path(name).exists() for name in notes), "every capture is kept"


def test_only_the_operator_enrols(serve) -> None:
    station = serve()
    operator, key = joined(station.port)
    watcher, other = joined(station.port)
    client = Asks(station.url, OWN)
    assert client.post("/api/v1/enrolment", name="gate-4", key=key).status == 200
    operator.until("operator", lambda m: m["you"])
    for path in ("", "/capture", "/drop", "/store", "/undo", "/cancel"):
        values: dict[str, Any] = {"name": "gate-5", "number": 1}
        for shown in (other, "made-up", None):
            answer = client.post(f"/api/v1/enrolment{path}", **values, key=shown)
            assert (answer.status, answer.json()["error"]["code"]) == (403, "not_operator"), path
    seen = watcher.until("status", lambda m: m["enrolment"]["subject"])["enrolment"]["subject"]
    assert seen == {"name": "gate-4", "kind": "other", "label": ""}
    assert client.post("/api/v1/enrolment/cancel", key=key).status == 200
    wait(lambda: state(station)["subject"] is None)
    operator.close()
    watcher.close()
