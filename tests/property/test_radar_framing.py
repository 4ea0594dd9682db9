"""Framing under any chunking of any bytes: damage costs the frames it hits, and nothing behind them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tagid.radar.framing import SYNC, Framing, StreamDecoder, frame
from tagid.radar.messages import MAX_PACKET_BYTES, MessageType, encode
from tagid.radar.scan_info import scan_packets
from tagid.radar.settings import RadarConfig

FRAMINGS = st.sampled_from(list(Framing))
CONFIG = RadarConfig(scan_start_ps=10_000, scan_stop_ps=15_000)
SYNC_WORDS = np.frombuffer(SYNC * 2, ">i4")[0]


def scan_of(values: list[int], scan_id: int) -> bytes:
    samples = np.zeros(CONFIG.samples, np.int32)
    samples[: len(values)] = values
    return scan_packets(samples, CONFIG, scan_id, scan_id)[0]


small = st.sampled_from([
    encode(MessageType.GET_CONFIG_REQUEST, 0xA5A5), encode(MessageType.CONTROL_CONFIRM, 7),
    encode(MessageType.SET_OPMODE_CONFIRM, 3, mode=0xA5A5A5A5), encode(MessageType.READY_INFO, 0),
])  # fmt: skip
# Samples that look like the sync word, like a frame's head, and plain ones.
counts = st.integers(-4000, 4000) | st.just(int(SYNC_WORDS)) | st.sampled_from([-0x5A5AFFFC, -0x5A5AFA54])
scans = st.builds(scan_of, st.lists(counts, max_size=CONFIG.samples), st.integers(0, 65_535))
packets = st.lists(small | scans, min_size=1, max_size=8)


def chunked(data: bytes, cuts: list[int]) -> list[bytes]:
    ends = [*sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in zip([0, *ends], ends, strict=False)]


def decoded(framing: Framing, chunks: list[bytes]) -> list[bytes]:
    decoder = StreamDecoder(framing)
    out = [packet for chunk in chunks for packet in decoder.feed(chunk)]
    return out + decoder.flush()


def test_frames_are_those_of_the_api() -> None:
    packet = bytes.fromhex("10020001")
    assert frame(packet, Framing.USB).hex() == "a5a50004" + "10020001"
    assert frame(packet, Framing.UART).hex() == "a5a50004" + "10020001" + "65e6"
    with pytest.raises(ValueError, match="holds"):
        frame(b"", Framing.USB)


@given(FRAMINGS, packets, st.lists(st.integers(0, 20_000), max_size=30))
@settings(max_examples=150, deadline=None)
def test_whole_frames_come_through_however_they_are_cut(
    framing: Framing, sent: list[bytes], cuts: list[int]
) -> None:
    """Also with sync words, and the heads of frames, among the samples."""
    stream = b"".join(frame(packet, framing) for packet in sent)
    assert decoded(framing, chunked(stream, cuts)) == sent


HEADS = [SYNC, SYNC[:1], SYNC + b"\x00\x04", SYNC + b"\x00\x04\x10\x02", SYNC + b"\x05\xac\xf2\x01"]
pieces = st.one_of(
    st.binary(max_size=40),
    st.sampled_from(HEADS),
    st.builds(frame, small | scans, FRAMINGS),
    st.builds(
        lambda whole, cut: whole[: cut % len(whole)], st.builds(frame, small, FRAMINGS), st.integers(1)
    ),
)


@given(FRAMINGS, st.lists(pieces, max_size=12).map(b"".join), st.lists(st.integers(0, 3000), max_size=30))
@settings(max_examples=150, deadline=None)
def test_any_bytes_give_the_same_packets_in_any_chunks(
    framing: Framing, data: bytes, cuts: list[int]
) -> None:
    once = decoded(framing, [data])
    assert decoded(framing, chunked(data, cuts)) == once
    assert decoded(framing, [data[i : i + 1] for i in range(len(data))]) == once


@given(
    FRAMINGS,
    packets,
    st.lists(st.tuples(st.integers(0, 8), st.binary(max_size=60) | st.just(SYNC * 9)), max_size=4),
    st.lists(st.integers(0, 20_000), max_size=10),
)
@settings(max_examples=150, deadline=None)
def test_noise_between_frames_changes_nothing_once_it_is_over(
    framing: Framing, sent: list[bytes], noise: list[tuple[int, bytes]], cuts: list[int]
) -> None:
    """Noise that holds no frame of its own is skipped; the frames around it come, in order."""
    frames = [frame(packet, framing) for packet in sent]
    for place, data in noise:
        # Two sync-free bytes keep the noise from being a frame's head by itself.
        frames.insert(place % (len(frames) + 1), data.replace(SYNC, SYNC + b"\xff\xff"))
    got = decoded(framing, chunked(b"".join(frames), cuts))
    if framing is Framing.UART:
        assert got == sent
    else:
        # Without a CRC a frame may end in noise unseen, but nothing is invented and the order holds.
        assert [packet for packet in got if packet in sent] == sent


@given(
    FRAMINGS,
    st.lists(scans, min_size=2, max_size=5),
    st.data(),
    st.lists(st.integers(0, 20_000), max_size=10),
)
@settings(max_examples=150, deadline=None)
def test_a_cut_frame_costs_itself_alone(
    framing: Framing, sent: list[bytes], data: st.DataObject, cuts: list[int]
) -> None:
    """Bytes vanish from one frame: it is dropped, not filled up with its successor's; all others come."""
    frames = [frame(packet, framing) for packet in sent]
    hit = data.draw(st.integers(0, len(frames) - 2))
    start = data.draw(st.integers(0, len(frames[hit]) - 1))
    stop = data.draw(st.integers(start + 1, len(frames[hit])))
    frames[hit] = frames[hit][:start] + frames[hit][stop:]
    stream = b"".join(frames)
    got = decoded(framing, chunked(stream, cuts))
    # One time in 65536 the CRC fits bytes that nobody sent together; a decoder cannot know.
    assume(framing is Framing.USB or all(p in sent or frame(p, framing) not in stream for p in got))
    others = sent[:hit] + sent[hit + 1 :]
    assert [packet for packet in got if packet in others] == others
    assert all(packet in sent for packet in got if len(packet) == MAX_PACKET_BYTES)


@pytest.mark.parametrize("framing", list(Framing))
def test_a_pause_in_the_middle_of_a_frame_costs_nothing(framing: Framing) -> None:
    whole = frame(scan_of([1, 2, 3], 5), framing)
    decoder = StreamDecoder(framing)
    assert decoder.feed(whole[:700]) == []
    assert decoder.flush() == []
    assert decoder.feed(whole[700:]) == [scan_of([1, 2, 3], 5)]
    assert (decoder.skipped, len(decoder._buffer)) == (0, 0)


@pytest.mark.parametrize("framing", list(Framing))
def test_a_cut_frame_does_not_swallow_the_answer_behind_it(framing: Framing) -> None:
    """The last bytes of a scan are lost, then one confirm and silence: the confirm must not wait for more."""
    confirm = encode(MessageType.CONTROL_CONFIRM, 9)
    assert decoded(framing, [frame(scan_of([1], 1), framing)[:600] + frame(confirm, framing)]) == [confirm]
