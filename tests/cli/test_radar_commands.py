"""`tagid radar` as a user types it, against emulated radars on loopback."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tagid.radar.emulation.core import EmulatorCore, Identity
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.links import UdpLink
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tests.emulators import UdpEmulator


class Silence:
    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return np.zeros(config.samples, np.int32)


def emulator(**identity: float) -> UdpEmulator:
    core = EmulatorCore(Silence(), identity=Identity(**identity))  # type: ignore[arg-type]
    return UdpEmulator(core, ServeOptions(port=0))


def test_find_asks_all_addresses_at_once_and_names_those_that_answer(tagid) -> None:
    with emulator(serial=7) as a, emulator(serial=8) as b:
        listed = ",".join(f"{d.address[0]}:{d.address[1]}" for d in (a, b)) + ",127.0.0.1:9"
        done = tagid("radar", "find", "--output", "json", TAGID_RADAR_ADDRESSES=listed)
        assert done.code == 0, done.err
        radars = done.json["data"]["radars"]
        assert [(r["url"], r["status"]["serial"]) for r in radars] == [(a.url, 7), (b.url, 8)]
        shown = tagid("radar", "find", TAGID_RADAR_ADDRESSES=listed)
        assert a.url in shown.out


def test_find_asks_the_addresses_of_the_configuration_file(tagid, home) -> None:
    del home["TAGID_RADAR_ADDRESSES"]
    with emulator(serial=9) as device:
        config = Path(home["TAGID_CONFIG"])
        config.parent.mkdir(exist_ok=True)
        config.write_text(f'[radar]\naddresses = ["127.0.0.1:{device.address[1]}"]\n')
        done = tagid("radar", "find", "--output", "json")
        assert [r["status"]["serial"] for r in done.json["data"]["radars"]] == [9]
        assert done.json["data"]["asked"] == [device.url]


def test_find_without_a_radar_says_where_to_look(tagid) -> None:
    done = tagid("radar", "find", "--output", "json")
    assert (done.code, done.json["errors"][0]["code"]) == (4, "device")
    assert done.json["data"]["asked"] == ["udp://127.0.0.1:9"]
    assert "21210" in done.json["errors"][0]["remedy"]


@pytest.mark.parametrize("bad", ["127.0.0.1:x", "u@h", "127.0.0.1:99999"])
def test_a_bad_address_is_named(tagid, bad: str) -> None:
    done = tagid("radar", "find", "--address", bad, "--output", "json")
    assert done.code == 2
    assert bad in done.json["errors"][0]["message"]


def test_info_decodes_what_the_radar_says(tagid) -> None:
    with emulator(serial=440, temperature_c=-3.25) as device:
        done = tagid("radar", "info", "--radar", device.url, "--output", "json")
        status = done.json["data"]["status"]
        assert (status["serial"], status["temperature_c"], status["built_in_test"]) == (440, -3.25, 0)
        assert status["mrm_version"] == "2.1.440"
        assert status["fpga_version"].endswith("(2016-12-31)")
        assert done.json["data"]["uptime_s"] >= 10
        text = tagid("radar", "info", "--radar", device.url).out
        assert "passed" in text
        assert "-3.25 degC" in text


def test_info_asks_without_stopping_a_recording(tagid) -> None:
    with emulator() as device, P440(UdpLink(*device.address)) as radar:
        run = radar.scans()
        next(run)
        assert tagid("radar", "info", "--radar", device.url).code == 0
        assert device.core.scanning
        run.close()
        radar.set_opmode(0)
        done = tagid("radar", "info", "--radar", device.url, "--output", "json")
        assert (done.json["data"]["opmode"], done.json["data"]["config"]) == (0, None)
        assert "MRM" in done.json["messages"][0]


def test_reboot_waits_until_the_radar_is_back(tagid) -> None:
    with emulator(boot_s=0.4) as device:
        done = tagid("radar", "reboot", "--radar", device.url, "--output", "json")
        assert done.code == 0, done.err
        assert done.json["data"]["seconds"] >= 0.4
        assert tagid("radar", "reboot", "--radar", device.url, "--wait", "0").code == 2


def test_without_a_radar_the_commands_say_how_to_name_one(tagid) -> None:
    for name in ("info", "reboot"):
        done = tagid("radar", name, "--output", "json")
        assert done.code == 2
        assert "radar find" in done.json["errors"][0]["remedy"]
