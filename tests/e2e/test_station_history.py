"""The station's history: export that is safe to open, captures, and a report over a selection."""

from __future__ import annotations

import csv
import io
import json
import socket
import zipfile
from pathlib import Path
from typing import Any

import pytest
from station_harness import OWN, Asks, ended, joined, wait

from tagid.config import data_folder
from tagid.station import server
from tagid.station.server import Server
from tagid.storage.history import FILE_NAME, History


def scanned(station: Server) -> int:
    """Scan once; the entry in the history."""
    client = Asks(station.url, OWN)
    assert client.post("/api/v1/scan").status == 202
    assert ended(station)["phase"] == "done"
    return int(client.get("/api/v1/history?limit=1").json()["items"][0]["id"])


def entry(file: Path, command: str = "station", **values: Any) -> int:
    """An entry of the history made by hand."""
    history = History(data_folder() / FILE_NAME)
    record = {"file": str(file), "status": "unknown", "tool_version": "1", "label": "", "reason": ""}
    record |= dict.fromkeys(("score", "margin", "missing", "extra"), 0)
    return history.add(history.begin(command, {}), [record | values])[0]


def test_a_report_over_a_selection(serve, tmp_path: Path) -> None:
    station = serve()
    client = Asks(station.url, OWN)
    first, second = scanned(station), scanned(station)
    gone = entry(tmp_path / "out" / "gone.tagid.h5")
    (tmp_path / "other").mkdir()
    for suffix in (".tagid.h5", ".png"):
        (tmp_path / "other" / f"scan{suffix}").touch()
    other = entry(tmp_path / "other" / "scan.tagid.h5")
    items = client.get("/api/v1/history").json()["items"]
    files = {item["id"]: (item["has_capture"], item["has_picture"]) for item in items}
    assert files == {first: (True, True), second: (True, True), gone: (False, False), other: (False, False)}
    for wrong in (None, [], ["1"], [True], [0], [-1], [10**19], list(range(1, 300)), {"a": 1}):
        assert client.post("/api/v1/reports", entries=wrong).status == 400, wrong
    refusal = client.post("/api/v1/reports", entries=[gone])
    assert refusal.status == 400 and "1 of 1 left out" in refusal.json()["error"]["message"]
    left_out = f"2 of 4 left out: their captures are not among the scans in {tmp_path / 'out'}"
    begun = client.post("/api/v1/reports", entries=[first, gone, second, other, first])
    assert begun.json() == {"number": 1, "left_out": left_out}
    assert client.post("/api/v1/reports", entries=[first]).json()["error"]["code"] == "busy"
    assert client.get("/api/v1/reports/1/report.html").status == 404, "it is not complete"
    answer = wait(lambda: (r := client.get("/api/v1/reports/1").json())["running"] is False and r)
    assert (answer["complete"], answer["done"], answer["total"], answer["error"]) == (True, 2, 2, None)
    assert answer["left_out"] == left_out
    page = client.get("/api/v1/reports/1/report.html")
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts;") and "allow-same-origin" not in policy
    assert left_out in page.text
    assert "helmet-120" in page.text and "attachment" not in page.headers.get("content-disposition", "")
    rows = list(csv.DictReader(io.StringIO(client.get("/api/v1/reports/1/items.csv").text)))
    assert [row["layout"] for row in rows] == ["helmet-120"] * 2
    assert client.get("/api/v1/reports/1/summary.json").json()["inputs"] == 2
    for path in ("2", "1/spool.sqlite", "1/..%2f..%2fhistory.sqlite", "9" * 30, "-1"):
        assert client.get(f"/api/v1/reports/{path}").status == 404, path
    assert len(client.get("/api/v1/history").json()["items"]) == 4, "a report adds nothing to the history"


def test_only_the_operator_begins_a_report_and_it_can_be_stopped(serve) -> None:
    station = serve()
    number = scanned(station)
    operator, key = joined(station.port)
    client = Asks(station.url, OWN)
    operator.say(type="take")
    operator.until("operator", lambda m: m["you"])
    for path in ("reports", "reports/stop"):
        assert client.post(f"/api/v1/{path}", entries=[number]).status == 403
    assert client.post("/api/v1/reports", entries=[number], key=key).status == 202
    assert client.post("/api/v1/reports/stop", key=key).status == 202
    message = operator.until("status", lambda m: m["report"] and not m["report"]["running"])["report"]
    assert message["number"] == 1 and message["error"] is None
    operator.close()


def test_export_is_safe_to_open_and_holds_the_captures(serve, tmp_path: Path) -> None:
    station = serve()
    client = Asks(station.url, OWN)
    real = scanned(station)
    wild = entry(tmp_path / "out" / "=cmd.tagid.h5", label="=1+1", reason="@SUM(A1)\x1b[31m")
    query = f"?entries={real},{wild}"
    text = client.get(f"/api/v1/history.csv{query}").text
    row = next(row for row in csv.DictReader(io.StringIO(text)) if row["id"] == str(wild))
    assert row["label"] == "'=1+1" and row["reason"].startswith("'@SUM") and "\x1b" not in text
    answer = client.get(f"/api/v1/history.json{query}")
    assert answer.headers["content-disposition"] == 'attachment; filename="tagid-history.json"'
    assert [row["id"] for row in answer.json()["items"]] == [wild, real] and "\x1b" not in answer.text
    for wrong in ("", "1,", "x", "0", "1;2", "1" * 30, ",".join(["1"] * 300)):
        assert client.get(f"/api/v1/history.csv?entries={wrong}").status == 400, wrong
    packed = zipfile.ZipFile(io.BytesIO(client.get(f"/api/v1/history/captures.zip{query}").content))
    (capture,) = (tmp_path / "out").glob("scan-*.tagid.h5")
    assert sorted(packed.namelist()) == ["history.csv", "history.json", capture.name]
    assert packed.testzip() is None and packed.read(capture.name) == capture.read_bytes()
    assert len(json.loads(packed.read("history.json"))["items"]) == 2
    assert client.get(f"/api/v1/history/{real}/capture").content == capture.read_bytes()
    assert client.get(f"/api/v1/history/captures.zip?entries={wild}").status == 404


def test_no_file_outside_the_folder_is_given_out(serve, tmp_path: Path) -> None:
    station = serve()
    client = Asks(station.url, OWN)
    secret = tmp_path / "secret.tagid.h5"
    secret.write_bytes(b"secret")
    link = tmp_path / "out" / "link.tagid.h5"
    link.symlink_to(secret)
    inside = tmp_path / "out" / "inside.tagid.h5"
    inside.write_bytes(b"no scan of the station")
    outside = (secret, tmp_path / "out" / ".." / "secret.tagid.h5", link, Path("/etc/passwd"))
    numbers = [*map(entry, outside), entry(inside, command="identify")]
    for number in numbers:
        for what in ("capture", "picture"):
            assert client.get(f"/api/v1/history/{number}/{what}").status == 404, number
    chosen = ",".join(map(str, numbers))
    assert client.get(f"/api/v1/history/captures.zip?entries={chosen}").status == 404
    assert client.post("/api/v1/reports", entries=numbers).status == 400


def test_a_client_that_does_not_read_its_download_is_disconnected(
    serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "STALL_S", 0.5)
    station = serve()
    large = tmp_path / "out" / "large.tagid.h5"
    with large.open("wb") as file:
        file.truncate(64 << 20)
    number = entry(large)
    for path in (f"/api/v1/history/{number}/capture", f"/api/v1/history/captures.zip?entries={number}"):
        wire = socket.socket()
        wire.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        wire.connect(("127.0.0.1", station.port))
        wire.sendall(f"GET {path} HTTP/1.1\r\nhost: 127.0.0.1:{station.port}\r\n\r\n".encode())
        wait(lambda: str(large) in open_files())
        wait(lambda: str(large) not in open_files())
        wire.close()
    assert Asks(station.url, {}).get("/api/v1/status").status == 200


def open_files() -> list[str]:
    """Names of the files that this process holds open."""
    results = []
    for link in Path("/proc/self/fd").iterdir():
        try:
            results.append(str(link.readlink()))
        except OSError:
            continue  # it was closed meanwhile
    return results
