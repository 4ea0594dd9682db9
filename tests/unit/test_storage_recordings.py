"""P440 recordings and logs: a lost packet costs its scan only, and real files come back byte for byte."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from tagid.capture import Capture, ViewFlag
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.errors import DataError, FileFormatError, UsageError
from tagid.metadata import RadarInfo, RadarSettings
from tagid.radar.framing import Framing, frame
from tagid.radar.messages import CONFIG_DTYPE, SCAN_INFO_DTYPE, MessageType, encode
from tagid.signal import analytic
from tagid.storage.assembly import unwrap
from tagid.storage.exporters import export
from tagid.storage.importers import read_any, remarks
from tagid.storage.recordings import encode_recording, read_recording

SHARED = Path(os.environ.get("TAGID_SHARED", Path(__file__).resolve().parents[2].parent / "shared"))
REAL = [SHARED / "data" / "p440" / name for name in ("corner-reflector-scan08.out", "light-pole-scan04.out")]
BINS = 768  # 350 + 350 + 68


def recording(first_id: int = 65_530, scans: int = 12, bins: int = BINS) -> tuple[np.ndarray, bytes]:
    """Samples of some scans and the file that a recorder would have written, made field by field."""
    samples = np.random.default_rng(1).integers(-90_000, 90_000, (scans, bins)).astype(np.int32)
    config = np.zeros(1, CONFIG_DTYPE)
    values = {"node_id": 5, "scan_start_ps": 10_000, "scan_stop_ps": 56_875, "resolution_bins": 32}
    for name, value in {**values, "base_integration_index": 11, "transmit_gain": 40}.items():
        config[name] = value
    out = config.tobytes()
    for i in range(scans):
        for index in range(-(-bins // 350)):
            packet = np.zeros(1, SCAN_INFO_DTYPE)
            part = samples[i, index * 350 : (index + 1) * 350]
            header = {
                "type": 0xF201, "id": (first_id + i) % 65_536, "node_id": 5,
                "timestamp_ms": (2**32 - 100 + 22 * i) % 2**32,
                "scan_start_ps": 10_000, "scan_stop_ps": 56_875, "step_bins": 32, "filter": 1, "reserved2": 3,
                "antenna_id": 2, "operation_mode": 1, "message_samples": len(part), "total_samples": bins,
                "message_index": index, "message_count": -(-bins // 350),
            }  # fmt: skip
            for name, value in header.items():
                packet[name] = value
            packet["samples"][0, : len(part)] = part
            out += packet.tobytes()
    return samples, out


def save(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def packets(data: bytes) -> list[bytes]:
    return [data[i : i + 1452] for i in range(32, len(data), 1452)]


def test_samples_ranges_and_unwrapped_counters(tmp_path: Path) -> None:
    samples, data = recording()
    capture = read_recording(save(tmp_path / "a.prd", data), cable_delay_ps=1_000.0)
    np.testing.assert_array_equal(capture.samples, samples)
    assert capture.samples.dtype == np.int32 and capture.samples.dtype.isnative
    assert capture.range_start_m == pytest.approx(9_000e-12 * SPEED_OF_LIGHT / 2)
    assert capture.range_step_m == pytest.approx(RANGE_STEP_M)
    np.testing.assert_array_equal(capture.scan_id, 65_530 + np.arange(12))
    np.testing.assert_array_equal(capture.radar_time_ms, 2**32 - 100 + 22 * np.arange(12))
    assert capture.radar.scans_lost == 0 and capture.radar.config.transmit_gain == 40
    assert capture.flags[0] == ViewFlag.FIRST and not capture.flags[1:].any()


def test_comes_back_byte_for_byte_through_every_format(tmp_path: Path) -> None:
    _, data = recording()
    capture = read_any(save(tmp_path / "a.out", data))
    for name in ("b.out", "b.tagid.h5", "b.npz"):
        export(capture, tmp_path / name)
        assert encode_recording(read_any(tmp_path / name)) == data


@pytest.mark.parametrize(
    ("spoil", "lost"),
    [
        (lambda parts: parts[:13] + parts[14:], [4]),
        (lambda parts: parts[:9] + parts[18:], [3, 4, 5]),
        (lambda parts: [*parts[:-2], parts[-2][:904]], [11]),
        (lambda parts: [*parts[:7], parts[7][:700], *parts[8:]], [2]),
    ],
    ids=["a fragment", "whole scans", "the end", "the end of a message"],
)
def test_what_is_lost_costs_its_scans_only(
    tmp_path: Path, spoil: Callable[[list[bytes]], list[bytes]], lost: list[int]
) -> None:
    samples, data = recording()
    capture = read_any(save(tmp_path / "a.out", data[:32] + b"".join(spoil(packets(data)))))
    np.testing.assert_array_equal(capture.samples, np.delete(samples, lost, axis=0))
    assert capture.radar.scans_lost == len(lost) and capture.flags is not None
    after = np.flatnonzero(capture.flags & ViewFlag.AFTER_LOSS).tolist()
    assert after == ([lost[0]] if lost[-1] < 11 else [])
    assert ("ignored: 1 cut message" in remarks(capture)) == (lost == [2])


def renumbered(data: bytes, ids: list[int], times_ms: list[int]) -> bytes:
    """The scans of a recording under other numbers and times, without the configuration."""
    messages = np.frombuffer(data[32:], SCAN_INFO_DTYPE).reshape(len(ids), -1).copy()
    messages["id"], messages["timestamp_ms"] = np.array(ids)[:, None], np.array(times_ms)[:, None]
    return messages.tobytes()


@pytest.mark.parametrize("restart_ms", [100_000, 3])
def test_two_recordings_in_one_file_follow_one_another(tmp_path: Path, restart_ms: int) -> None:
    samples, data = recording(scans=40)
    steps = list(range(40))
    first = renumbered(data, steps, [1000 + 8 * step for step in steps])
    second = renumbered(data, steps, [1000 + restart_ms + 8 * step for step in steps])
    capture = read_recording(save(tmp_path / "a.out", data[:32] + first + second))
    np.testing.assert_array_equal(capture.samples, np.concatenate([samples, samples]))
    assert capture.scan_id.tolist() == steps + steps and capture.radar.scans_lost == 0


def test_scans_in_the_order_of_their_file_names_are_sorted_by_time(tmp_path: Path) -> None:
    samples, data = recording(scans=200, bins=350)
    ids = [(65_500 + step) % 65_536 for step in range(200)]
    plain = renumbered(data, ids, [1000 + 8 * step for step in range(200)])
    parts = [plain[at : at + 1452] for at in range(0, len(plain), 1452)]
    content = b"".join(parts[number] for number in sorted(range(200), key=str))
    capture = read_recording(save(tmp_path / "a.out", content))
    np.testing.assert_array_equal(capture.samples, samples)
    assert capture.radar.scans_lost == 0


def test_scans_without_numbers_and_times_stay_in_the_order_of_the_file(tmp_path: Path) -> None:
    samples, data = recording(scans=20)
    capture = read_recording(save(tmp_path / "a.out", renumbered(data, [0] * 20, [0] * 20)))
    np.testing.assert_array_equal(capture.samples, samples)


@pytest.mark.parametrize("swapped", ["samples", "configuration", "both"])
@pytest.mark.parametrize("order", [">", "<"])
def test_parts_of_another_byte_order(tmp_path: Path, swapped: str, order: str) -> None:
    samples, data = recording()
    messages = np.frombuffer(data[32:], SCAN_INFO_DTYPE).astype(SCAN_INFO_DTYPE.newbyteorder(order))
    config = np.frombuffer(data[:32], CONFIG_DTYPE).astype(CONFIG_DTYPE.newbyteorder(order))
    if swapped != "configuration":
        messages["samples"] = messages["samples"].byteswap()
    if swapped != "samples":
        config = config.byteswap()
    capture = read_recording(save(tmp_path / "a.out", config.tobytes() + messages.tobytes()))
    np.testing.assert_array_equal(capture.samples, samples)
    assert capture.radar.config.base_integration_index == 11 and capture.radar.config.scan_start_ps == 10_000


def test_order_repeats_and_foreign_packets_do_not_matter(tmp_path: Path) -> None:
    samples, data = recording()
    kept = packets(data)
    kept[4], kept[7] = kept[7], kept[4]
    kept[12:18] = kept[15:18] + kept[12:15]
    foreign = b"\x11\x03" + kept[0][2:]
    wrong = kept[0][:42] + b"\xff\xff" + kept[0][44:]
    shuffled = data[:32] + b"".join([*kept[:5], kept[2], foreign, wrong, *kept[5:]])
    capture = read_recording(save(tmp_path / "a.out", shuffled))
    np.testing.assert_array_equal(capture.samples, samples)
    assert capture.radar.scans_lost == 0 and capture.radar.packets_ignored == 2
    note = "1 CONTROL_CONFIRM message, 2896 bytes of no message, the first at byte 8752"
    assert note in remarks(capture)[0]


def test_two_runs_in_one_file_lose_nothing(tmp_path: Path) -> None:
    samples, data = recording(first_id=500)
    capture = read_recording(save(tmp_path / "a.out", data + data[32:]))
    assert capture.views == 12  # the same scans again are repeats
    _, second = recording(first_id=0)
    capture = read_recording(save(tmp_path / "a.out", data + second[32:]))
    np.testing.assert_array_equal(capture.samples, np.concatenate([samples, samples]))
    assert capture.radar.scans_lost == 0


def test_clipped_views_are_marked(tmp_path: Path) -> None:
    samples, _ = recording(first_id=0, scans=3)
    samples[1, 5] = -127 << 11
    samples[2, 5] = -(2**31)
    radar = RadarInfo(config=RadarSettings(base_integration_index=11))
    capture = Capture(samples, 1.0, RANGE_STEP_M, radar_time_ms=np.arange(3.0), radar=radar)
    again = read_recording(save(tmp_path / "a.out", encode_recording(capture)))
    assert (again.flags & ViewFlag.CLIPPED).astype(bool).tolist() == [False, True, True]


def test_capture_from_elsewhere_keeps_its_ranges(tmp_path: Path) -> None:
    samples, _ = recording()
    radar = RadarInfo(cable_delay_ps=11_000.0)
    for start in (0.4, 1.7, 5.498793264636):
        capture = Capture(samples, start, RANGE_STEP_M, radar_time_ms=np.arange(12.0), radar=radar)
        path = save(tmp_path / "a.out", encode_recording(capture))
        again = read_recording(path, cable_delay_ps=11_000)
        assert again.range_start_m == pytest.approx(start, abs=1e-4)  # whole ps are 0.15 mm
        np.testing.assert_array_equal(again.samples, samples)


@pytest.mark.parametrize("suffix", [".out", ".csv"])
def test_what_the_format_cannot_hold(tmp_path: Path, suffix: str) -> None:
    counts, times = np.ones((2, 96), np.int32), {"radar_time_ms": np.arange(2.0)}
    loud, below = (RadarInfo(config=RadarSettings(transmit_gain=bad)) for bad in (2**40, -1))
    cases = [
        (Capture(counts.astype(np.float32), 0.0, 0.01, **times), UsageError, "int32"),
        (Capture(counts, 0.0, 0.01), DataError, "times"),
        (
            Capture(counts, 0.0, 0.01, radar=loud, **times),
            DataError,
            "transmit_gain|does not fit an MRM-RET log",
        ),
    ]
    if suffix == ".out":
        cases.append((Capture(np.ones((2, 9000), np.int32), 0.0, 0.01, **times), DataError, "bins"))
        cases.append((Capture(counts, 0.0, 0.01, radar=below, **times), DataError, "transmit_gain"))
    for capture, error, said in cases:
        with pytest.raises(error, match=said):
            export(capture, tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


def confirm(block: bytes, status: int = 0) -> bytes:
    fields = {"config": np.frombuffer(block, CONFIG_DTYPE)[0], "timestamp_ms": 900, "status": status}
    return encode(MessageType.GET_CONFIG_CONFIRM, 77, **fields)


def swapped(data: bytes) -> bytes:
    """The same fields as a program stores them that converted them to its own byte order."""
    dtypes = (CONFIG_DTYPE, SCAN_INFO_DTYPE)
    parts = (np.frombuffer(data[:32], CONFIG_DTYPE), np.frombuffer(data[32:], SCAN_INFO_DTYPE))
    pairs = zip(parts, dtypes, strict=True)
    return b"".join(part.astype(dtype.newbyteorder("<")).tobytes() for part, dtype in pairs)


def counted(messages: list[bytes], size: int, order: Literal["big", "little"]) -> bytes:
    return b"".join(len(message).to_bytes(size, order) + message for message in messages)


NOISE = np.random.default_rng(9)
DETECTIONS = encode(MessageType.DETECTION_LIST_INFO, 3)
CONTROL = encode(MessageType.CONTROL_CONFIRM, 4)
WRAPPED = {
    "confirm": lambda block, parts: confirm(block) + b"".join(parts),
    "request": lambda block, parts: encode(MessageType.SET_CONFIG_REQUEST, 1)[:4] + block + b"".join(parts),
    "usb": lambda block, parts: b"".join(frame(p, Framing.USB) for p in [confirm(block), *parts]),
    "uart": lambda block, parts: b"".join(frame(p, Framing.UART) for p in [confirm(block), *parts]),
    "big-endian lengths": lambda block, parts: counted([confirm(block), *parts], 4, "big"),
    "little-endian lengths": lambda block, parts: counted([confirm(block), *parts], 2, "little"),
    "captured packets": lambda block, parts: b"".join(NOISE.bytes(58) + p for p in [confirm(block), *parts]),
    "times and newlines": lambda block, parts: block + b"".join(b"\n1700000000.123 " + p for p in parts),
    "detections": lambda block, parts: block + b"".join(p + DETECTIONS for p in parts),
    "confirms": lambda block, parts: CONTROL + confirm(block) + CONTROL + b"".join(parts) + CONTROL,
    "noise": lambda block, parts: NOISE.bytes(70_000) + confirm(block) + NOISE.bytes(9).join(parts),
    "filtered": lambda block, parts: block + b"".join(p[:38] + b"\4" + p[39:] + p for p in parts),
    "unpadded": lambda block, parts: block + b"".join(p[: 52 + 4 * int.from_bytes(p[42:44])] for p in parts),
    "other byte order": lambda block, parts: swapped(block + b"".join(parts)),
}


@pytest.mark.parametrize("kind", WRAPPED)
def test_messages_are_read_whatever_lies_between_them(tmp_path: Path, kind: str) -> None:
    samples, data = recording()
    expected = read_any(save(tmp_path / "a.out", data))
    path = save(tmp_path / "b.bin", WRAPPED[kind](data[:32], packets(data)))
    capture = read_any(path)
    np.testing.assert_array_equal(capture.samples, samples)
    assert capture.radar.config == expected.radar.config
    assert (capture.radar.scan_info or {})["filter"] == 1 and capture.radar.bytes_left_over == 0
    notes = "; ".join(remarks(capture))
    expected_note = {
        "detections": "ignored: 36 DETECTION_LIST_INFO messages",
        "filtered": "ignored: 36 filtered messages of the same radar",
        "confirms": "ignored: 3 CONTROL_CONFIRM messages",
        "usb": "ignored: 148 bytes of no message, the first at byte 0",
    }.get(kind, "")
    assert expected_note in notes
    assert notes or kind in ("confirm", "request", "unpadded", "other byte order")
    export(capture, tmp_path / "c.out")
    np.testing.assert_array_equal(read_any(tmp_path / "c.out").samples, samples)


def test_a_recording_without_configuration_says_what_is_unknown(tmp_path: Path) -> None:
    samples, data = recording()
    for block, said in (
        (b"", "no configuration"),
        (b"measured by us on 27 Nov 2026   ", "32 bytes of no message"),
    ):
        capture = read_any(save(tmp_path / "a.out", block + b"".join(packets(data))))
        np.testing.assert_array_equal(capture.samples, samples)
        assert capture.radar.config == RadarSettings() and any(said in remark for remark in remarks(capture))


def test_noise_and_lone_marks_are_no_scans(tmp_path: Path) -> None:
    data = bytearray(np.random.default_rng(2).bytes(1 << 21))
    for at in range(0, len(data) - 52, 64):
        data[at : at + 4] = b"\xf2\1\0\1"
        data[at + 44 : at + 46] = b"\0\0"
    with pytest.raises(FileFormatError, match="unknown file format"):
        read_any(save(tmp_path / "a.out", bytes(data)))


def test_too_short(tmp_path: Path) -> None:
    _, data = recording()
    for size in (0, 10, 32, 100, 1483):
        with pytest.raises(FileFormatError):
            read_recording(save(tmp_path / "a.out", data[:size]))


def test_hostile_counters_take_no_memory(tmp_path: Path) -> None:
    _, data = recording(scans=60, bins=96)
    raw = np.frombuffer(data[32:], SCAN_INFO_DTYPE).copy()
    raw["id"] = (np.arange(60) * 32_000) % 65_536
    raw["total_samples"][::7] = 2**32 - 1
    raw["message_count"][1::7] = 65_535
    capture = read_recording(save(tmp_path / "a.out", data[:32] + raw.tobytes()))
    assert 30 < capture.views < 60


def test_unwrap_goes_both_ways() -> None:
    assert unwrap(np.array([2, 65_535, 3, 1]), 65_536).tolist() == [2, -1, 3, 1]


@pytest.mark.skipif(
    not all(p.is_file() for p in REAL), reason="the real recordings are not beside the checkout"
)
class TestReal:
    """The two recordings of a real P440 (200 scans of 1152 samples)."""

    @pytest.mark.parametrize("path", REAL, ids=lambda p: p.stem)
    def test_shape_and_byte_for_byte(self, path: Path, tmp_path: Path) -> None:
        capture = read_any(path)
        assert capture.samples.shape == (200, 1152) and capture.radar.scans_lost == 0
        export(capture, tmp_path / "a.tagid.h5")
        export(read_any(tmp_path / "a.tagid.h5"), tmp_path / "b.out")
        assert (tmp_path / "b.out").read_bytes() == path.read_bytes()

    def test_the_corner_reflector_stays_in_its_bin_and_the_scan_period_is_the_formulas(self) -> None:
        capture = read_any(REAL[0])
        formula = 0.867 + 1152 / 12 * 2**11 * 105.31e-6
        assert np.ptp(capture.radar_time_ms) / 199 == pytest.approx(formula, abs=0.01)
        assert np.ptp(np.abs(analytic(capture.samples)).argmax(axis=1)) <= 2
