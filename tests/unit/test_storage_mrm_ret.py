"""The vendor's log: several radars, stale settings, cut ends, and the way back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.errors import FileFormatError, UsageError
from tagid.metadata import RadarInfo, RadarSettings
from tagid.storage.exporters import export
from tagid.storage.importers import read_any, remarks
from tagid.storage.recordings import encode_recording

BINS = 96
STOP = 15_858


def config(node: int, start: int = 10_000, stop: int = STOP, pii: int = 11) -> str:
    return f"1700000000.100, Config, {node}, {start}, {stop}, 32, {pii}, 0, 0, 0, 0, 0, 0, 0, 0, 2, 63, 0"


def scan(number: int, samples: np.ndarray, node: int = 7, filtering: int = 1, start: int = 10_000) -> str:
    head = (
        f"{1_700_000_000 + number}.123, MrmFullScanInfo, {number}, {node}, {1000 + 20 * number}, 0, 0, 0, 0, "
    )
    head += f"{start}, {start + STOP - 10_000}, 32, {filtering}, 2, 3, {len(samples)}, "
    return head + ", ".join(map(str, samples.tolist()))


def log(path: Path, *lines: str, end: str = "\r\n") -> Path:
    path.write_bytes(("\r\n".join(lines) + end).encode())
    return path


@pytest.fixture
def samples() -> np.ndarray:
    return np.random.default_rng(3).integers(-200_000, 200_000, (6, BINS)).astype(np.int32)


def test_a_stale_config_line_gives_its_settings_but_not_its_window(tmp_path: Path, samples) -> None:
    lines = [
        config(7, 20_000, 50_000, pii=12), "1700000000.200, MrmControlRequest, 1, 5, 0, 0",
        *(scan(i, samples[i]) for i in (0, 1, 3)), scan(5, samples[5]).replace(", 96, ", ", 97, "),
    ]  # fmt: skip
    capture = read_any(log(tmp_path / "a.csv", *lines))
    np.testing.assert_array_equal(capture.samples, samples[[0, 1, 3]])
    assert capture.radar_time_ms.tolist() == [1000, 1020, 1060] and capture.radar.scans_lost == 2
    assert capture.range_start_m == pytest.approx(10_000e-12 * SPEED_OF_LIGHT / 2)
    assert capture.range_step_m == pytest.approx(RANGE_STEP_M)
    assert capture.radar.config_stale is True
    assert capture.radar.window_requested_ps == (20_000, 50_000)
    assert capture.radar.window_actual_ps == (10_000, STOP)
    assert capture.radar.config.scan_start_ps == 10_000
    assert capture.radar.config.base_integration_index == 12
    assert any("stale" in text and "20000" in text for text in remarks(capture))


def test_of_several_config_lines_the_one_that_fits_the_scans_is_taken(tmp_path: Path, samples) -> None:
    lines = [config(7, pii=9), config(7, 20_000, 50_000, pii=12), scan(0, samples[0]), config(7, pii=15)]
    capture = read_any(log(tmp_path / "a.csv", *lines))
    assert capture.radar.config.base_integration_index == 9
    assert capture.radar.config_stale is False
    assert remarks(capture) == ()


def test_several_radars_are_told_apart(tmp_path: Path, samples) -> None:
    lines = [config(101, pii=9), config(102, 20_000, 20_000 + STOP - 10_000, pii=13)]
    for i in range(6):
        lines.append(scan(i, samples[i], *((101,) if i % 2 else (102, 1, 20_000))))
    path = log(tmp_path / "a.csv", *lines)
    with pytest.raises(UsageError, match="101, 102") as caught:
        read_any(path)
    assert "`node=101`" in caught.value.remedy
    with pytest.raises(UsageError, match="node 5"):
        read_any(path, node=5)
    for node, rows, pii, start in ((101, [1, 3, 5], 9, 10_000), (102, [0, 2, 4], 13, 20_000)):
        capture = read_any(path, node=node)
        np.testing.assert_array_equal(capture.samples, samples[rows])
        assert capture.radar.node_id == node
        assert capture.radar.config.base_integration_index == pii
        assert capture.range_start_m == pytest.approx(start * 1e-12 * SPEED_OF_LIGHT / 2)
        assert capture.radar.packets_ignored == 0


def test_several_radars_in_one_recording(tmp_path: Path, samples) -> None:
    parts = []
    for node in (3, 4):
        radar = RadarInfo(node_id=node, config=RadarSettings(node_id=node))
        capture = Capture(samples + node, 1.5, RANGE_STEP_M, radar_time_ms=np.arange(6.0), radar=radar)
        parts.append(encode_recording(capture))
    packets = [[data[i : i + 1452] for i in range(32, len(data), 1452)] for data in parts]
    mixed = b"".join(a + b for a, b in zip(*packets, strict=True))
    (tmp_path / "a.prd").write_bytes(parts[0][:32] + mixed)
    with pytest.raises(UsageError, match="3, 4"):
        read_any(tmp_path / "a.prd")
    for node in (3, 4):
        np.testing.assert_array_equal(read_any(tmp_path / "a.prd", node=node).samples, samples + node)
    export(read_any(tmp_path / "a.prd", node=4), tmp_path / "b.tagid.h5")
    assert read_any(tmp_path / "b.tagid.h5", node=4).views == 6
    with pytest.raises(UsageError, match="node 3"):
        read_any(tmp_path / "b.tagid.h5", node=3)


@pytest.mark.parametrize("cut", [1, 30, 300, 420])
def test_a_log_cut_anywhere_keeps_whole_scans_and_counts_the_rest(tmp_path: Path, samples, cut: int) -> None:
    path = log(tmp_path / "a.csv", config(7), *(scan(i, samples[i]) for i in range(6)))
    data = path.read_bytes()
    last = len(data) - data.rstrip().rfind(b"\n") - 1
    path.write_bytes(data[: -2 - cut])
    capture = read_any(path)
    if cut == 1:  # a digit of the very last number: nothing shows that it is missing
        assert capture.views == 6
        return
    np.testing.assert_array_equal(capture.samples, samples[:5])
    assert capture.radar.bytes_left_over == last - 2 - cut
    assert any(f"{last - 2 - cut} bytes" in text for text in remarks(capture))


def test_a_recording_cut_anywhere_says_what_was_left_over(tmp_path: Path, samples) -> None:
    data = encode_recording(Capture(samples, 1.5, RANGE_STEP_M, radar_time_ms=np.arange(6.0)))
    for cut in (1, 700, 1451, 1452, 2000):
        (tmp_path / "a.prd").write_bytes(data[:-cut])
        capture = read_any(tmp_path / "a.prd")
        np.testing.assert_array_equal(capture.samples, samples[: 6 - -(-cut // 1452)])
        assert capture.radar.bytes_left_over == -cut % 1452


def test_the_vendors_c_example_logs_without_reserved_columns(tmp_path: Path, samples) -> None:
    lines = [config(7)]
    for i in range(3):
        values = ", ".join(map(str, samples[i].tolist()))
        head = f"{1_700_000_000 + i}, MrmFullScanInfo, {i}, 7, {20 * i}, 10000, {STOP}, 32, 1, 2, {BINS}"
        lines.append(f"{head}, {values}")
    capture = read_any(log(tmp_path / "a.csv", *lines))
    np.testing.assert_array_equal(capture.samples, samples[:3])
    assert capture.range_start_m == pytest.approx(10_000e-12 * SPEED_OF_LIGHT / 2)
    assert capture.host_time_ns[2] == 1_700_000_002 * 10**9


def test_out_and_back_with_detection_lists(tmp_path: Path, samples) -> None:
    lines = [config(7, 20_000, 50_000)]
    for i in range(4):
        lines += [scan(i, samples[i]), scan(i, samples[i] // 2, filtering=4)]
        lines.append(f"{1_700_000_000 + i}.124, MrmDetectionListInfo, {i}, 2, {10 + i}, 500, 40, {i}")
    lines.append("1700000004.124, MrmDetectionListInfo, 3, 5, 1")  # cut off
    first = read_any(log(tmp_path / "a.csv", *lines))
    assert first.radar.detection_lists[1] == "1: 11 500, 40 1"
    assert len(first.radar.detection_lists) == 4
    export(first, tmp_path / "b.csv")
    again = read_any(tmp_path / "b.csv")
    np.testing.assert_array_equal(again.samples, samples[:4])
    np.testing.assert_array_equal(again.host_time_ns, first.host_time_ns)
    np.testing.assert_array_equal(again.radar_time_ms, first.radar_time_ms)
    for name in ("detection_lists", "config", "window_requested_ps", "window_actual_ps", "scan_info"):
        assert getattr(again.radar, name) == getattr(first.radar, name), name
    export(again, tmp_path / "c.csv")
    assert (tmp_path / "c.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_numbers_that_are_none_cost_their_line_only(tmp_path: Path, samples) -> None:
    lines = [config(7), *(scan(i, samples[i]) for i in range(4))]
    for bad in ("1_0", "0x10", "1e-3", "1.5", "", "99999999999", str(2**40), "nan", "1 2"):
        spoiled = lines[2].rsplit(",", 1)[0] + f", {bad}"
        path = log(tmp_path / "a.csv", *lines[:2], spoiled, *lines[3:])
        np.testing.assert_array_equal(read_any(path).samples, samples[[0, 2, 3]], err_msg=bad)
    good = scan(0, samples[0])
    for bad in (
        "x" * 500_000,
        "x, MrmFullScanInfo, 1",
        "a, Config, b",
        good.replace(", 96, ", ", 1000000000, "),
        good.replace("15858, 32,", "15858, 0,"),
    ):
        with pytest.raises(FileFormatError):
            read_any(log(tmp_path / "a.csv", config(7), bad))


def resaved(lines: list[str], kind: str) -> bytes:
    """The log as other programs save it."""
    cells = [line.split(", ") for line in lines]
    floats = [
        [c + ".0" if at > 1 and c.lstrip("-").isdigit() else c for at, c in enumerate(row)] for row in cells
    ]
    plain = "\r\n".join(lines)
    width = max(map(len, cells))
    padded = [row + [""] * (width - len(row)) for row in cells]
    index = [str(n) for n in range(width)]

    def joined(delimiter: str, rows: list[list[str]] = cells) -> str:
        return "\n".join(delimiter.join(row) for row in rows)

    text = {
        "no spaces": joined(","),
        "semicolons": joined(";").replace(".", ","),
        "tabs": joined("\t"),
        "bars": joined(" | "),
        "spaces": joined(" "),
        "quotes": joined(",", [[f'"{c}"' for c in row] for row in cells]),
        "quoted thousands": joined(",", [[f'"{int(c):,}"' if c.lstrip("-").isdigit() and at > 1 else c
                                          for at, c in enumerate(row)] for row in cells]),
        "carriage returns": plain.replace("\r\n", "\r"),
        "blank lines": plain.replace("\r\n", "\r\n\r\n,,,\r\n"),
        "empty cells": joined(",", padded),
        "floats": joined(",", floats),
        "scientific": joined(",", [[f"{int(c):.6e}" if at > 15 and c.lstrip("-").isdigit() else c
                                    for at, c in enumerate(row)] for row in cells]),
        "frame": joined(",", [["", *index], *([str(n), *row] for n, row in enumerate(
            [row + ["nan"] * (width - len(row)) for row in floats]))]),
        "wrapped": joined(",\n", [[", ".join(row[at : at + 16]) for at in range(0, len(row), 16)]
                                  for row in cells]),
        "bytes": plain, "utf-8-sig": plain, "utf-16": plain, "utf-16-le": plain, "utf-16-be": plain,
    }[kind]  # fmt: skip
    return text.encode(kind if kind.startswith("utf") else "ascii")


RESAVED = (
    "no spaces", "semicolons", "tabs", "bars", "spaces", "quotes", "quoted thousands", "carriage returns",
    "blank lines", "empty cells", "floats", "scientific", "frame", "wrapped", "utf-8-sig", "utf-16",
    "utf-16-le", "utf-16-be",
)  # fmt: skip


@pytest.mark.parametrize("kind", RESAVED)
@pytest.mark.parametrize("headings", [True, False])
def test_a_log_that_another_program_saved_again(tmp_path: Path, samples, kind: str, headings: bool) -> None:
    lines = [config(7), *(scan(i, samples[i]) for i in range(4)), scan(4, samples[4], filtering=4)]
    if headings:
        lines = ["Timestamp, Config, NodeId", lines[0], "Timestamp, MrmFullScanInfo, MessageId", *lines[1:]]
    (tmp_path / "a.csv").write_bytes(resaved(lines, kind))
    capture = read_any(tmp_path / "a.csv")
    np.testing.assert_array_equal(capture.samples, samples[:4])
    assert capture.host_time_ns[2] == 1_700_000_002_123_000_000
    assert capture.radar.config.transmit_gain == 63
    assert remarks(capture) == ("ignored: 1 filtered scan of the same radar",)


@pytest.mark.parametrize(
    ("first", "known"),
    [
        ("17000000{}123", True),  # ms, us and ns since 1970
        ("17000000{}123000", True),
        ("17000000{}123000000", True),
        ("6393130578{}2080000", False),  # ticks, in an unknown time zone
        ("26.11.2026 22:13:{}", False),
        ("2026-11-26, 22:13:{}", False),
        ("22:13:{}.208", False),
        ("46352.92{}", False),  # days, of a spreadsheet
        ("inf", False),
        ("", False),
    ],
)
def test_the_hosts_time_may_be_unknown(tmp_path: Path, samples, first: str, known: bool) -> None:
    lines = [f"{first.format(10 + i)}, {scan(i, samples[i]).split(', ', 1)[1]}" for i in range(4)]
    capture = read_any(log(tmp_path / "a.csv", *lines))
    np.testing.assert_array_equal(capture.samples, samples[:4])
    if known:
        assert (capture.host_time_ns // 10**6).tolist() == [1_700_000_010_123 + 1000 * i for i in range(4)]
    else:
        assert capture.host_time_ns is None and any("host's times" in text for text in remarks(capture))


def test_a_log_stored_twice_is_read_once(tmp_path: Path, samples) -> None:
    lines = [scan(i, samples[i]) for i in range(6)]
    capture = read_any(log(tmp_path / "a.csv", config(7), *lines, *lines))
    np.testing.assert_array_equal(capture.samples, samples)
    assert "ignored: 6 scans stored again" in remarks(capture)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda line: line + ", note", "line 2 has 111 columns"),
        (lambda line: line.replace(", 10000,", ", 10,000,"), "line 2 has 111 columns"),
        (lambda line: line.replace(", 7,", ", seven,"), "lines can be read"),
        (lambda line: line.replace(", 96, ", ", 96, 0.5, ").rpartition(",")[0], "line 2 has samples missing"),
        (lambda line: line.replace(", 7, ", ", '7, ", 1), "line 2 begins"),
    ],
)
def test_a_log_of_which_no_line_is_readable_says_why(tmp_path: Path, samples, change, said: str) -> None:
    lines = [change(scan(i, samples[i])) for i in range(6)]
    with pytest.raises(FileFormatError, match="none of the log's 6 MrmFullScanInfo lines") as raised:
        read_any(log(tmp_path / "a.csv", config(7), *lines))
    assert said in raised.value.message


def test_names_in_lower_case_swiss_thousands_and_times_since_1904(tmp_path: Path, samples) -> None:
    lines = [scan(i, samples[i]).replace("MrmFull", "mrmfull").split(", ") for i in range(6)]
    swiss = [
        "; ".join([*line[:16], *(f"{int(cell):,}".replace(",", "'") for cell in line[16:])]) for line in lines
    ]
    swiss = [line.replace("17000000", "37828448", 1) for line in swiss]
    capture = read_any(log(tmp_path / "a.csv", *swiss))
    np.testing.assert_array_equal(capture.samples, samples)
    assert capture.host_time_ns is None and any("the host's times" in remark for remark in remarks(capture))
