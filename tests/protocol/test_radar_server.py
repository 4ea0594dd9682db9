"""What the vendor's server program sends besides raw scans, as `--server` emulates it."""

from __future__ import annotations

import numpy as np
import pytest
from radar_ends import THREE_FRAGMENTS

from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.firmware import Firmware
from tagid.radar.messages import Message, MessageType, Status, decode, encode
from tagid.radar.scan_info import read_fragment
from tagid.radar.settings import RadarConfig
from tagid.waveform import nominal_pulse, pulse_at

T = MessageType
AT = 400


class Jumping:
    """An echo at sample 400 in every second scan, beside one at sample 100 that stands still."""

    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        n = np.arange(config.samples)
        still = 3000 * pulse_at(nominal_pulse(), (n - 100) * 61.035e-12).real
        moving = 2000 * (index % 2) * pulse_at(nominal_pulse(), (n - AT) * 61.035e-12).real
        noise = np.random.default_rng(index).normal(0, 20, config.samples)
        return np.rint(still + moving + noise).astype(np.int32)


def server(mask: int, multiplier: int = 0) -> tuple[EmulatorCore, Message]:
    core = EmulatorCore(Jumping(), THREE_FRAGMENTS, firmware=Firmware(server=True))
    fields = {"mask": mask, "motion_index": 1, "threshold_multiplier": multiplier}
    (answer,) = core.handle(encode(T.SET_FILTER_REQUEST, 1, **fields))
    core.handle(encode(T.CONTROL_REQUEST, 10, scan_count=65_535))
    return core, decode(answer)


def test_a_detection_list_comes_with_each_scan_and_names_what_moved() -> None:
    core, answer = server(1 | 8)
    assert answer["status"] == Status.OK
    (got,) = core.handle(encode(T.GET_FILTER_REQUEST, 2))
    assert (decode(got)["mask"], decode(got)["motion_index"]) == (9, 1)
    lists = []
    for number in range(6):
        packets = core.step()
        assert [p[:2] for p in packets] == [b"\xf2\x01"] * 3 + [b"\x12\x01"]
        message = decode(packets[-1])
        assert message.id == 10 + number == read_fragment(packets[0]).id
        lists.append(message)
    assert lists[0]["count"] == 0  # nothing to compare the first scan with
    for message in lists[1:]:
        count = message["count"]
        assert count >= 1
        result = message.fields["detections"][:count]
        best = result[np.argmax(result["magnitude"])]
        assert abs(int(best["index"]) - AT) <= 2
        assert int(best["magnitude"]) == pytest.approx(2000, rel=0.1)
        assert not (np.abs(result["index"].astype(int) - 100) < 10).any()
        assert (np.diff(result["index"].astype(int)) > 0).all()


def test_a_higher_threshold_detects_less() -> None:
    counts = []
    for multiplier in (2, 6, 255):
        core, _ = server(8, multiplier)
        counts.append([decode(core.step()[-1])["count"] for _ in range(4)][-1])
    assert counts[0] > counts[1] >= 1 > counts[2] - 1
    assert counts[2] == 0


def test_each_filter_is_sent_as_its_own_scan() -> None:
    core, _ = server(1 | 2 | 4)
    core.step()
    packets = core.step()
    kinds = [packet[36 + 2] for packet in packets]  # the filter's byte, after the header's step_bins
    assert kinds == [1, 1, 1, 2, 2, 2, 4, 4, 4]
    parts = [np.concatenate([read_fragment(p).samples for p in packets[k : k + 3]]) for k in (0, 3, 6)]
    raw, band, motion = (part.astype(float) for part in parts)
    assert np.abs(raw - band)[90:110].max() < 200
    assert np.abs(motion)[90:110].max() < 200 < 1500 < np.abs(motion)[AT - 5 : AT + 6].max()


@pytest.mark.parametrize("mask", [0, 16, 9 | 16])
def test_a_mask_that_names_nothing_known_is_refused(mask: int) -> None:
    assert server(mask)[1]["status"] == Status.UNSUPPORTED_VALUE
