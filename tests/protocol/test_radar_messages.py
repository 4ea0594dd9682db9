"""Exact bytes of every message, and what happens to bytes that are none."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.errors import ConfigError
from tagid.radar.messages import (
    CONFIG_DTYPE,
    MESSAGES,
    MalformedMessage,
    MessageType,
    Status,
    decode,
    encode,
    status_text,
)
from tagid.radar.settings import RadarConfig

T = MessageType
CONFIG = RadarConfig(scan_start_ps=36684, scan_stop_ps=106996)
# The head of a real recording: node 1, 36684..106996 ps, 32 bins, PII 11, B to A, gain 63.
CONFIG_HEX = "0000000100008f4c0001a1f40020000b" + "0000" * 4 + "00" * 4 + "023f0000"
C = CONFIG.to_record()

EXACT = [
    (T.SET_CONFIG_REQUEST, {"config": C}, "1001 0102" + CONFIG_HEX),
    (T.SET_CONFIG_CONFIRM, {"status": 3}, "1101 0102 00000003"),
    (T.GET_CONFIG_REQUEST, {}, "1002 0102"),
    (T.GET_CONFIG_CONFIRM, {"config": C, "timestamp_ms": 258, "status": 1},
     "1102 0102" + CONFIG_HEX + "00000102 00000001"),
    (T.CONTROL_REQUEST, {"scan_count": 65535, "interval_us": 1}, "1003 0102 ffff 0000 00000001"),
    (T.CONTROL_CONFIRM, {}, "1103 0102 00000000"),
    (T.SERVER_CONNECT_REQUEST, {"ip": 0xC0A80164, "port": 21210}, "1004 0102 c0a80164 52da 0000"),
    (T.SERVER_CONNECT_CONFIRM, {}, "1104 0102 00000000"),
    (T.SERVER_DISCONNECT_REQUEST, {}, "1005 0102"),
    (T.SERVER_DISCONNECT_CONFIRM, {}, "1105 0102 00000000"),
    (T.SET_FILTER_REQUEST, {"mask": 1, "motion_index": 2, "threshold_multiplier": 3}, "1006 0102 0001 02 03"),
    (T.SET_FILTER_CONFIRM, {}, "1106 0102 00000000"),
    (T.GET_FILTER_REQUEST, {}, "1007 0102"),
    (T.GET_FILTER_CONFIRM, {"mask": 8}, "1107 0102 0008 00 00 00000000"),
    (T.DETECTION_LIST_INFO, {"count": 1}, "1201 0102 0001 0000" + "00" * 1400),
    (T.GET_STATUSINFO_REQUEST, {}, "f001 0102"),
    (T.GET_STATUSINFO_CONFIRM,
     {"mrm_major": 2, "mrm_build": 440, "serial": 7, "temperature_quarter_c": -1, "package": b"P440"},
     "f101 0102 02 00 01b8 00 00 0000 00000000 00000007 00000000 ffffffff 50343430" + "00" * 32),
    (T.REBOOT_REQUEST, {}, "f002 0102"),
    (T.REBOOT_CONFIRM, {}, "f102 0102"),
    (T.SET_OPMODE_REQUEST, {"mode": 1}, "f003 0102 00000001"),
    (T.SET_OPMODE_CONFIRM, {"mode": 1, "status": 2}, "f103 0102 00000001 00000002"),
    (T.GET_OPMODE_REQUEST, {}, "f004 0102"),
    (T.GET_OPMODE_CONFIRM, {"mode": 1}, "f104 0102 00000001"),
    (T.SET_SLEEPMODE_REQUEST, {"mode": 4}, "f005 0102 00000004"),
    (T.SET_SLEEPMODE_CONFIRM, {}, "f105 0102 00000000"),
    (T.GET_SLEEPMODE_REQUEST, {}, "f006 0102"),
    (T.GET_SLEEPMODE_CONFIRM, {"mode": 4}, "f106 0102 00000004 00000000"),
    (T.SET_BAUD_REQUEST, {"persist": 1, "baud": 115200}, "f00b 0102 01 00 0000 0001c200"),
    (T.SET_BAUD_CONFIRM, {}, "f10b 0102 00000000"),
    (T.INVALID_MESSAGE_CONFIRM, {"bad_type": 0x1003, "bad_id": 9, "status": 5},
     "f10c 0102 1003 0009 00000005"),
    (T.SCAN_INFO,
     {"node_id": 1, "timestamp_ms": 1300269, "scan_start_ps": 36684, "scan_stop_ps": 106996, "step_bins": 32,
      "filter": 1, "reserved2": 3, "antenna_id": 2, "operation_mode": 1, "message_samples": 2,
      "total_samples": 1052, "message_index": 3, "message_count": 4, "samples": [-1, 2] + [0] * 348},
     "f201 0102 00000001 0013d72d" + "00" * 16 + "00008f4c 0001a1f4 0020 01 03 02 01 0002 0000041c 0003 0004"
     "ffffffff 00000002" + "00" * 1392),
    (T.READY_INFO, {}, "f202 0102"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "fields", "expected"), EXACT, ids=[e[0].name for e in EXACT])
def test_bytes_are_exactly_those_of_the_api_and_come_back(
    kind: MessageType, fields: dict[str, object], expected: str
) -> None:
    data = bytes.fromhex(expected)
    assert encode(kind, 0x0102, **fields) == data
    message = decode(data)
    assert (message.type, message.id, message.name) == (kind, 0x0102, kind.name)
    assert message.fields.tobytes() == data
    for wrong in (data + b"\0", data[:-1]):
        with pytest.raises(MalformedMessage) as caught:
            decode(wrong)
        assert caught.value.status == Status.WRONG_SIZE


def test_every_message_of_the_table_has_its_exact_bytes_here() -> None:
    assert {e[0] for e in EXACT} == set(MessageType) == {MessageType(k) for k in MESSAGES}


def test_old_firmware_is_understood() -> None:
    short = bytes.fromhex("f101 0001 02 00 01b8 00 00 0000 00000000 00000007 00000000 000000a4 00000002")
    message = decode(short)
    assert len(short) == 32
    assert (message["serial"], message["temperature_quarter_c"], message["status"]) == (7, 164, 2)
    assert bytes(message.fields["package"]) == b""
    assert decode(bytes.fromhex("f106 0001 00000001"))["mode"] == 1


def test_unknown_types_and_values() -> None:
    with pytest.raises(MalformedMessage) as caught:
        decode(bytes.fromhex("12340001"))
    assert caught.value.status == Status.UNRECOGNISED
    with pytest.raises(ValueError, match="outside"):
        encode(T.CONTROL_REQUEST, 1, scan_count=65536)
    with pytest.raises(KeyError):
        encode(T.CONTROL_REQUEST, 1, scans=1)
    assert status_text(0x99) == "unknown status 0x99"


def test_the_grid_is_that_of_the_real_radar() -> None:
    """15000 becomes 14999; the recordings' window is a fixed point and holds 1152 samples."""
    assert RadarConfig(scan_start_ps=15000, scan_stop_ps=30000).quantised().scan_start_ps == 14999
    assert CONFIG.quantised() == CONFIG
    assert CONFIG.samples == 1152
    assert CONFIG.to_bytes().hex() == CONFIG_HEX
    assert RadarConfig.from_bytes(CONFIG.to_bytes()) == CONFIG
    assert CONFIG.scan_period_s == pytest.approx(21.573e-3, abs=2e-6)
    assert CONFIG.clip_counts == 127 * 2048
    # 36684 ps are 5.4988 m one way; a delay of 10 ns takes 1.4990 m off.
    assert CONFIG.range_start_m() == pytest.approx(5.4988, abs=1e-4)
    assert CONFIG.range_start_m(10_000) == pytest.approx(3.9998, abs=1e-4)


def test_quantising_twice_changes_nothing_and_cuts_nothing_off() -> None:
    for start in range(-5000, 100_000, 997):
        once = RadarConfig(scan_start_ps=start, scan_stop_ps=start + 20_000).quantised()
        assert once.quantised() == once
        assert once.samples % 96 == 0
        assert once.samples * 61.03515625 == pytest.approx(once.scan_stop_ps - once.scan_start_ps, abs=1.0)
        assert once.scan_stop_ps >= start + 20_000 - 4


@pytest.mark.parametrize(
    "bad",
    [{"transmit_gain": 64}, {"base_integration_index": 5}, {"code_channel": 11}, {"antenna_mode": 4},
     {"scan_stop_ps": 10_000}, {"scan_stop_ps": 2_000_000}, {"scan_start_ps": 1.5}],
)  # fmt: skip
def test_settings_out_of_range_are_refused(bad: dict[str, int]) -> None:
    with pytest.raises(ConfigError) as caught:
        RadarConfig(**bad)
    assert caught.value.message
    assert caught.value.remedy


def test_a_block_of_noise_is_no_configuration() -> None:
    block = np.frombuffer(bytes(range(200, 232)), CONFIG_DTYPE)[0]
    with pytest.raises(ConfigError):
        RadarConfig.from_record(block)
    with pytest.raises(ConfigError):
        RadarConfig.from_bytes(b"\0" * 31)
