"""What the fuzzers drive: each parser of bytes that come from a wire or a file, with seeds to begin from.

A target takes any bytes and must come back, or raise an error of the tree; whatever else happens is a fault.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from tagid.capture import Capture, Pulse
from tagid.constants import RANGE_STEP_M
from tagid.enrolling.layout_file import layouts_to_toml, read_layouts
from tagid.errors import TagidError
from tagid.metadata import RadarInfo, RadarSettings
from tagid.pipeline.prepared import intake_remarks
from tagid.radar.assembler import MAX_PENDING, MAX_READY, ScanAssembler
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.framing import Framing, StreamDecoder, frame
from tagid.radar.messages import MAX_PACKET_BYTES, MAX_SAMPLES_PER_SCAN, MessageType, decode, encode
from tagid.radar.scan_info import read_fragment, scan_packets
from tagid.radar.settings import RadarConfig
from tagid.simulate.response import Response, Ring
from tagid.simulate.response_file import read_response, write_response
from tagid.storage.exporters import export
from tagid.storage.importers import read_any
from tagid.storage.journal import JournalWriter
from tagid.tags.layouts.layout import Layout, builtin_layouts, layout_from_dict
from train.detector import Contract

CONFIG = RadarConfig(scan_start_ps=10_000, scan_stop_ps=45_000)


@dataclass(frozen=True)
class Target:
    """One parser."""

    name: str
    run: Callable[[bytes], None]  # raises only what is a fault
    seeds: Callable[[], list[bytes]]  # well-formed inputs, from which mutation starts
    share: float  # of the executions of a long run
    longest: int = 4096  # bytes of the longest input worth trying


def _message(data: bytes) -> None:
    try:
        message = decode(data)
    except TagidError:
        return
    if message.type is MessageType.SCAN_INFO:
        fragment = read_fragment(data)
        assert fragment is None or len(fragment.samples) == message["message_samples"]


def _messages() -> list[bytes]:
    plain = [encode(kind, 7) for kind in MessageType]
    samples = np.arange(576, dtype=np.int32) - 300
    return plain + scan_packets(samples, CONFIG, 3, 1000)


def _framing(framing: Framing) -> Callable[[bytes], None]:
    def run(data: bytes) -> None:
        decoder = StreamDecoder(framing)
        out: list[bytes] = []
        at, size = 0, 1 + (len(data) * 7 + (data[0] if data else 0)) % 61
        while at < len(data):
            out += decoder.feed(data[at : at + size])
            at += size
            size = 1 + (size * 5 + 3) % 397
            assert len(decoder._buffer) <= MAX_PACKET_BYTES + 8 + 397
        out += decoder.flush()
        assert sum(map(len, out)) + decoder.skipped + len(decoder._buffer) <= len(data)
        for packet in out:
            _message(packet)

    return run


def _frames(framing: Framing) -> Callable[[], list[bytes]]:
    def seeds() -> list[bytes]:
        frames = [frame(packet, framing) for packet in _messages()]
        sync = encode(MessageType.SCAN_INFO, 1, samples=np.full(350, -0x5A5A5A5B, np.int32))
        return [*frames, b"".join(frames[:8]), b"noise" + frames[0] + frames[1][:5] + frames[2],
                frame(sync, framing) * 2]  # fmt: skip

    return seeds


def _scans(data: bytes) -> None:
    """Fragments with any header: every 13 bytes set the fields that regrouping looks at."""
    assembler = ScanAssembler(0, clock_ns=lambda: 1)
    names = ("message_samples", "total_samples", "message_index", "message_count")
    for at in range(0, len(data) - 12, 13):
        word = data[at : at + 13]
        values = [int.from_bytes(word[i : i + 2], "big") for i in (2, 4, 6, 8)]
        fields = dict(zip(names, values, strict=True), timestamp_ms=word[10] % 3)
        fragment = read_fragment(encode(MessageType.SCAN_INFO, word[0] << 8 | word[1], **fields))
        for scan in assembler.add(fragment) if fragment else ():
            assert len(scan.samples) <= MAX_SAMPLES_PER_SCAN
        assert len(assembler._pending) <= MAX_PENDING
        assert len(assembler._ready) <= MAX_READY


def _scan_headers() -> list[bytes]:
    def header(number: int, index: int, total: int = 800) -> bytes:
        here, count = min(350, total - 350 * index), -(-total // 350)
        words = (number, here, total, index, count)
        return b"".join(word.to_bytes(2, "big") for word in words) + bytes([0, 0, 0])

    return [b"".join(header(n, i) for n in range(4) for i in range(3)), header(0, 0, 96) * 3]


class _Ramp:
    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return np.full(config.samples, index, np.int32)


def _requests(data: bytes) -> None:
    """A client that says anything: the emulated radar answers in well-formed messages or not at all."""
    core = EmulatorCore(_Ramp(), CONFIG)
    for at in range(0, len(data), 40):
        for answer in core.handle(data[at : at + 40]) + core.step():
            decode(answer)


def _request_seeds() -> list[bytes]:
    requests = [encode(kind, 7) for kind in MessageType if len(encode(kind, 7)) <= 40]
    return [packet.ljust(40, b"\0")[: max(len(packet), 4)] for packet in requests]


@cache
def _folder() -> Path:
    """A folder in memory where there is one: a fuzzer writes millions of files."""
    memory = Path("/dev/shm")
    return Path(tempfile.mkdtemp(prefix="tagid-fuzz-", dir=memory if memory.is_dir() else None))


def _read_as_file(data: bytes, read: Callable[[Path], Any]) -> Any:
    """What the bytes hold; None where they end in an error of the tree."""
    path = _folder() / "input"
    path.write_bytes(data)
    try:
        return read(path)
    except TagidError as error:
        assert path.name in error.message
        return None


def read_bytes_as_file(data: bytes) -> Capture | None:
    return _read_as_file(data, read_any)


def _response(data: bytes) -> None:
    _read_as_file(data, read_response)


def _importer(data: bytes) -> None:
    capture = read_bytes_as_file(data)
    if capture is not None:
        assert all(intake_remarks(capture))


def example(bins: int = 96, views: int = 4) -> Capture:
    """A small capture that every format can hold."""
    rng = np.random.default_rng(5)
    return Capture(
        rng.integers(-90_000, 90_000, (views, bins)).astype(np.int32),
        1.5,
        RANGE_STEP_M,
        angles_rad=np.arange(float(views)),
        axis_distance_m=1.0,
        host_time_ns=1_700_000_000_000_000_000 + 20_000_000 * np.arange(views),
        radar_time_ms=20.0 * np.arange(views),
        scan_id=np.arange(views),
        pulse=Pulse(np.ones(5), 1e-11),
        radar=RadarInfo(
            config=RadarSettings(base_integration_index=11), detection_lists=("1: 4 5",), node_id=7
        ),
    )


def encoded(suffix: str, capture: Capture | None = None) -> bytes:
    """A capture as the bytes of a file of that suffix."""
    capture = capture or example()
    path = _folder() / f"seed{suffix}"
    path.unlink(missing_ok=True)
    if suffix != ".tagid.journal":
        export(capture, path)
    else:
        header = {"range_start_m": 1.5, "range_step_m": RANGE_STEP_M, "radar": capture.radar.to_json()}
        with JournalWriter(path, header, sync_every=0) as journal:
            for number, row in enumerate(capture.samples):
                journal.append(number, number, float(number), row)
            journal.close({"radar": {"scans_lost": 0}})
    return path.read_bytes()


def _response_seeds() -> list[bytes]:
    """A small response in the own layout, once compressed and once stored, and one in the plain layout."""
    rings = (Ring(0.8, "V"), Ring(1.0, "V"))
    values = np.full((2, 2, 4), 0.01 + 0.02j, dtype=np.complex64)
    path = _folder() / "response.npz"
    write_response(path, Response("seed", np.array([3e9, 4e9]), rings, values, provenance={"made": "here"}))
    with np.load(path) as loaded:
        base = dict(loaded)
    plain = {"S": values, "freqs": base["frequency_hz"], "azimuth": base["aspect_rad"]}
    plain |= {"ring_distance": base["ring_distance_m"], "ring_pol": base["ring_polarisation"]}
    seeds = [path.read_bytes()]
    for arrays in (base, plain):
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        seeds.append(buffer.getvalue())
    return seeds


def stored_npz(capture: Capture) -> bytes:
    """Not compressed, so that mutations reach the arrays and not only the deflate stream."""
    buffer = io.BytesIO()
    times = np.asarray(capture.radar_time_ms)
    np.savez(buffer, samples=capture.samples, range_start_m=1.5, range_step_m=0.01, timestamps_s=times)
    return buffer.getvalue()


def _matlab() -> list[bytes]:
    """The structs of the vendor's log reader, and tagid's own variables, not compressed."""
    scan = {"msgID": 1, "srcID": 7, "Tstmp": 9, "Tstrt": 100, "Tstp": 500, "Nbin": 32, "Nfilt": 1, "antID": 2}
    scans = np.empty((1, 3), [(name, object) for name in (*scan, "scn")])
    for name, value in scan.items():
        scans[name][:] = value
    for at in range(3):
        scans["scn"][0, at] = np.arange(12, dtype=np.int32)[:, None]
    buffers = [io.BytesIO(), io.BytesIO()]
    savemat(buffers[0], {"cfg": {"nodeID": 7, "BII": 11}, "scn": scans})
    savemat(buffers[1], {"scn": scans}, do_compression=True)
    return [buffer.getvalue() for buffer in buffers]


def _wrapped() -> list[bytes]:
    """A recording in frames, after a confirm, and among other messages."""
    data = encoded(".prd")
    block, parts = data[:32], [data[at : at + 1452] for at in range(32, len(data), 1452)]
    confirm = encode(MessageType.GET_CONFIG_CONFIRM, 1)[:4] + block + bytes(8)
    other = encode(MessageType.CONTROL_CONFIRM, 2)
    framed = b"".join(frame(part, Framing.UART) for part in [confirm, *parts])
    return [framed, confirm + b"".join(parts), other.join(parts), b"\n".join(parts)]


def _resaved() -> list[bytes]:
    """The log with other delimiters, encodings and forms of numbers."""
    text = encoded(".csv").decode()
    semicolons = text.replace(", ", ";").replace(".", ",")
    quoted = text.replace(", ", '","').replace("\r\n", '"\r\n"')
    return [semicolons.encode(), quoted.encode(), text.encode("utf-16"), text.replace(", ", "\t").encode()]


def _layouts(data: bytes) -> None:
    for layout in _read_as_file(data, read_layouts) or ():
        assert layout_from_dict(layout.to_dict()).to_dict() == layout.to_dict()


def _layout_seeds() -> list[bytes]:
    points = np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])
    seen = np.tile([[1e-6, 2e-7], [2e-7, 3e-6]], (3, 1, 1))
    measured = Layout("a", points, "helmet", 0, "n", "L", np.array([0.0, 0.05, 0.0]), seen)
    return [layouts_to_toml([measured]).encode(), layouts_to_toml([*builtin_layouts().values()]).encode()]


def _contract(data: bytes) -> None:
    with suppress(TagidError):
        Contract.from_text(data.decode("utf-8", "replace"), "a model")


def _contract_seeds() -> list[bytes]:
    return [Contract(1.0, 0.0, 1.0, 0.0, 1.0, {"0.1": 0.5, "0.01": 0.9}, {"seed": 0}).to_text().encode()]


def _seeds_of(suffix: str) -> Callable[[], list[bytes]]:
    return lambda: [encoded(suffix), encoded(suffix, example(400, 2))]


TARGETS = (
    Target("message", _message, _messages, 0.859, 1600),
    Target("framing-usb", _framing(Framing.USB), _frames(Framing.USB), 0.03, 3200),
    Target("framing-uart", _framing(Framing.UART), _frames(Framing.UART), 0.03, 3200),
    Target("regrouping", _scans, _scan_headers, 0.005, 260),
    Target("requests", _requests, _request_seeds, 0.02, 240),
    Target("recording", _importer, _seeds_of(".prd"), 0.008, 14_000),
    Target("wrapped", _importer, _wrapped, 0.003, 14_000),
    Target("mrm-ret", _importer, _seeds_of(".csv"), 0.006, 8000),
    Target("resaved", _importer, _resaved, 0.002, 8000),
    Target("journal", _importer, _seeds_of(".tagid.journal"), 0.01, 8000),
    Target("npz", _importer, lambda: [*_seeds_of(".npz")(), stored_npz(example())], 0.008, 8000),
    Target("matlab", _importer, _matlab, 0.003, 8000),
    Target("response", _response, _response_seeds, 0.003, 6000),
    Target("hdf5", _importer, _seeds_of(".tagid.h5"), 0.003, 30_000),
    Target("layouts", _layouts, _layout_seeds, 0.005, 2000),
    Target("contract", _contract, _contract_seeds, 0.005, 2000),
)
"""Every parser there is; the shares add up to 1 and go by what an execution costs."""
