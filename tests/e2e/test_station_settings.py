"""Setting up the station over its sockets: settings, searches, the range profile, and files sent to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from station_harness import ENDLESS, OWN, Answer, Asks, ended, joined

from tagid.cli.options import demo_settings
from tagid.config import config_path, load_config
from tagid.errors import UsageError
from tagid.operate.workplace import Workplace
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.settings import RadarConfig
from tagid.simulate.spec import SceneSpec, turning_scene
from tagid.station import settings as station_settings
from tagid.station import stored
from tagid.station.demo import demo_objects
from tagid.station.openapi import document
from tagid.station.security import MOST_UPLOAD_BYTES
from tagid.station.server import Server
from tagid.station.station import Source
from tests.emulators import UdpEmulator

pytestmark = pytest.mark.usefixtures("closed_clients")


@pytest.fixture
def configured(serve: Any, monkeypatch: pytest.MonkeyPatch) -> Server:
    """A station whose settings are those of its configuration file."""
    station = serve(check=lambda config: [])
    station._station.source = Source(Workplace)
    monkeypatch.setattr(station_settings, "bluetooth_devices", lambda seconds: [])
    return station


def shown(answer: Any) -> dict[str, Any]:
    return {item["name"]: item["value"] for item in answer.json()["items"]}


def test_settings_are_written_to_the_file_of_config_set(configured: Server) -> None:
    client = Asks(configured.url, OWN)
    before = client.get("/api/v1/settings")
    assert sorted(before.json()) == document()["components"]["schemas"]["Settings"]["required"]
    assert shown(before)["radar.url"] is None and shown(before)["motion.url"] == "free"
    values = {
        "radar.url": "udp://192.168.1.101",
        "motion.url": "free?rpm=2.5",
        "motion.axis_distance_m": "1.02",
        "station.until_sure": "yes",
    }
    answer = client.post("/api/v1/settings", changes=values)
    assert answer.status == 200, answer.text
    stored_ones = load_config()
    assert stored_ones["radar.url"] == "udp://192.168.1.101" and stored_ones["motion.axis_distance_m"] == 1.02
    assert stored_ones["motion.url"].public == "free?rpm=2.5" and stored_ones["station.until_sure"] == "yes"
    # All or none, and the refusal says what may be given.
    text = config_path().read_text()
    half_right = {"radar.url": "udp://10.0.0.9", "motion.axis_distance_m": 100}
    half = client.post("/api/v1/settings", changes=half_right)
    assert half.status == 400 and "Give metres" in half.json()["error"]["message"]
    assert config_path().read_text() == text


def test_a_browser_sets_no_device_of_its_choice(configured: Server) -> None:
    client = Asks(configured.url, OWN)
    for changes in (
        {"radar.url": "replay:///etc/passwd"},
        {"radar.url": "emulator://helmet-120?file=/etc/passwd"},
        {"radar.url": "serial:///dev/sda"},
        {"radar.url": "udp://evil.example"},
        {"radar.url": "udp://8.8.8.8"},
        {"radar.url": "udp://127.0.0.1:1@evil.example"},
        {"radar.url": ""},
        {"motion.url": "roomba+serial:///dev/sda"},
        {"motion.url": "free?rpm=0"},
        {"motion.url": "free?rpm=1e9"},
        {"motion.url": "free?rpm=2\n[storage]"},
        {"motion.url": "roomba+ble://R2?passkey=123456"},
        {"storage.folder": "/etc"},
        {"radar.addresses": "8.8.8.8"},
        {"station.until_sure": "maybe"},
        {"station.until_sure": True},
        {"motion.axis_distance_m": [1]},
        {"motion.axis_distance_m": "nan"},
        [],
        None,
    ):
        answer = client.post("/api/v1/settings", changes=changes)
        assert answer.status == 400, (changes, answer.text)
        assert not config_path().exists(), changes


def test_a_radar_that_the_search_found_can_be_chosen(
    configured: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Asks(configured.url, OWN)
    core = EmulatorCore(turning_scene(SceneSpec("helmet-120")), RadarConfig())
    with UdpEmulator(core, ServeOptions(port=0)) as radar:
        monkeypatch.setenv("TAGID_RADAR_ADDRESSES", radar.url.removeprefix("udp://"))
        result = client.post("/api/v1/settings/find", kind="radar").json()["found"]["radar"]
    (device,) = result["devices"]
    assert device["url"] == radar.url and device["problem"] == "" and "serial" in device["text"]
    assert client.post("/api/v1/settings", changes={"radar.url": radar.url}).status == 200
    motion = [station_settings.Device("roomba+serial:///dev/ttyUSB7", "adapter")]
    monkeypatch.setattr(station_settings, "_motions", lambda: station_settings.Search(tuple(motion)))
    for kind in ("bridge", 1, None):
        assert client.post("/api/v1/settings/find", kind=kind).status == 400
    refused = client.post("/api/v1/settings", changes={"motion.url": motion[0].url})
    assert refused.status == 400, "before the search"
    client.post("/api/v1/settings/find", kind="motion")
    assert client.post("/api/v1/settings", changes={"motion.url": motion[0].url}).status == 200
    assert load_config()["motion.url"].public == motion[0].url


def test_only_the_operator_sets_up_and_not_what_the_command_line_gave(serve: Any) -> None:
    station = serve(ENDLESS)
    client = Asks(station.url, OWN)
    fixed = client.post("/api/v1/settings", changes={"radar.url": "udp://192.168.1.101"})
    assert fixed.status == 400 and "when the station was started" in fixed.json()["error"]["message"]
    operator, key = joined(station.port)
    operator.say(type="take")
    operator.until("operator", lambda message: message["you"])
    asked: dict[str, dict[str, Any]] = {
        "settings": {"changes": {"station.until_sure": "yes"}},
        "settings/find": {"kind": "motion"},
        "profile": {},
    }
    for path, values in asked.items():
        assert client.post(f"/api/v1/{path}", **values).status == 403, path
    assert upload(station, b"x").status == 403
    # While a scan runs nothing is changed, and the range profile gives the radar to it.
    assert client.post("/api/v1/profile", key=key).status == 202
    profile = operator.until("profile", lambda message: message["scans"] > 3)
    assert profile["object_m"] == [0.75, 1.25] and profile["axis_m"] == 1.0 and profile["running"]
    at = profile["echo_db"].index(max(profile["echo_db"]))
    assert len(profile["echo_db"]) == len(profile["moving_db"]) > 300 and at < 30, "the antennas' leakage"
    assert client.post("/api/v1/scan", key=key).status == 202
    operator.until("profile", lambda message: not message["running"] and message["error"] is None)
    operator.until("frame", lambda message: message["scan"]["scans"] > 3)
    for path, values in asked.items():
        assert client.post(f"/api/v1/{path}", **values, key=key).json()["error"]["code"] == "busy", path
    assert upload(station, b"x", key=key).json()["error"]["code"] == "busy"
    operator.close()


def upload(station: Server, content: bytes, name: str = "a.tagid.h5", key: str = "", **more: str) -> Answer:
    headers = {"content-type": "application/octet-stream", "tagid-file-name": name, **more}
    if key:
        headers["tagid-key"] = key
    return Asks(station.url, OWN).ask("POST", "/api/v1/captures", content, headers)


def test_a_file_is_identified_and_a_capture_replayed(serve: Any, tmp_path: Path) -> None:
    station = serve()
    client = Asks(station.url, OWN)
    client.post("/api/v1/scan", note="first")
    assert ended(station)["has_residuals"]
    assert client.get("/api/v1/scan/residuals").content.startswith(b"\x89PNG")
    (entry,) = client.get("/api/v1/history").json()["items"]
    assert entry["has_residuals"]
    small = client.get(f"/api/v1/history/{entry['id']}/thumbnail").content
    assert small.startswith(b"\x89PNG") and len(small) < 12_000
    assert client.get(f"/api/v1/history/{entry['id']}/residuals").content.startswith(b"\x89PNG")
    content = Path(entry["file"]).read_bytes()
    before = sorted((tmp_path / "out").iterdir())
    # Nothing of a replay is stored; its answer is that of the file.
    assert client.post(f"/api/v1/history/{entry['id']}/replay").json() == {"number": 2}
    replayed = ended(station)
    assert (replayed["file"], replayed["answer"]["layout"]) == (Path(entry["file"]).name, "helmet-120")
    assert replayed["scans"] > 30 and replayed["has_residuals"]
    assert sorted((tmp_path / "out").iterdir()) == before
    assert len(client.get("/api/v1/history").json()["items"]) == 1
    assert client.post("/api/v1/history/99/replay").status == 404
    # The name of a file that is sent is no path.
    answer = upload(station, content, "..%2F..%2Fmy scan%00.tagid.h5".replace(" ", "%20"))
    assert answer.status == 202 and answer.json() == {"number": 3, "file": "received-my-scan-.tagid.h5"}
    read = ended(station)
    assert read["phase"] == "done" and read["answer"]["layout"] == "helmet-120"
    new, _ = client.get("/api/v1/history").json()["items"]
    assert new["has_capture"] and new["has_picture"] and new["recording_note"] == "first"
    assert Path(new["file"]) == tmp_path / "out" / "received-my-scan-.tagid.h5"
    assert client.get(f"/api/v1/history/{new['id']}/capture").content == content
    # Again by the same name; what cannot be read is not kept.
    sent = upload(station, b"no capture at all", "my scan.tagid.h5").json()
    assert sent["file"] == "received-my-scan.tagid.h5"
    failed = ended(station)
    assert failed["phase"] == "failed" and "unknown file format" in failed["note"]
    assert not (tmp_path / "out" / "received-my-scan.tagid.h5").exists()


def test_a_file_is_bounded_and_refused_to_strangers(
    serve: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    station = serve()
    assert upload(station, b"", "a.h5").status == 400
    assert upload(station, b"x", **{"content-type": "application/json"}).status == 415
    assert upload(station, b"x", **{"origin": "http://evil.example"}).status == 403
    assert upload(station, b"x", **{"content-length": str(MOST_UPLOAD_BYTES + 1)}).status == 413
    monkeypatch.setattr(stored, "MOST_UPLOAD_BYTES", 10)
    assert upload(station, b"x" * 11).status == 400
    monkeypatch.setattr(stored, "LEAST_FREE_BYTES", 1 << 60)
    assert upload(station, b"x").status == 507
    assert list((tmp_path / "out").iterdir()) == []
    paired: list[str] = []
    other = serve(announce=paired.append)
    assert upload(other, b"x").status == 401
    for path in ("settings", "profile"):
        assert Asks(other.url, OWN).get(f"/api/v1/{path}").status == 401


def test_a_scan_may_end_early_if_the_settings_say_so_but_not_an_enrolment(
    serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TAGID_STATION_UNTIL_SURE", "yes")
    station = serve(ENDLESS)
    client = Asks(station.url, OWN)
    spent = []
    for path in ("scan", "enrolment/capture"):
        client.post("/api/v1/enrolment", name="gate-4")
        assert client.post(f"/api/v1/{path}").status == 202
        spent.append(station._station.scan._plan.spent)
        client.post("/api/v1/scan/stop")
        ended(station)
    assert spent[0] > 0 and spent[1] == 0, "what the looks of an early ending may be wrong"
    # Without a known angle the refusal names the page's own control.
    place = station._station.source.place().config
    free = {name: entry.value for name, entry in place.values.items() if name != "motion.url"}
    station._station.source = Source(lambda: Workplace(free))
    refused = client.post("/api/v1/scan")
    assert refused.status == 503 and "“End a scan as soon as" in refused.json()["error"]["message"]


def test_the_second_object_of_the_demonstration_moves_and_is_not_enrolled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TAGID_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "c.toml"))
    quick = {"imaging.method": "bp", "radar.integration": 15, "storage.folder": str(tmp_path)}
    settings = {**demo_settings("helmet-120", {}), **quick}
    demo = Source(lambda: Workplace(settings), demo=demo_objects("helmet-120", settings))
    urls = [demo.of_object("demo-object", number).radar_url() for number in range(8)]
    assert len({url.rpartition("&seed")[0] for url in urls}) == 8 and all(
        "demo_object.toml" in url for url in urls
    )
    assert demo.of_object("", 5).radar_url() == settings["radar.url"]
    with pytest.raises(UsageError, match="no object"):
        demo.of_object("other", 1)
    with Workplace({**settings, "radar.url": urls[1].replace("rate=1", "rate=0")}) as place:
        answer = place.scan()
    assert answer.status == "unknown" and answer.name is None
