"""Any bytes, and well-formed ones spoiled: every parser ends in a value or an error, in bounded memory.

The long run of the same targets is `fuzz_parsers.py` beside this file.
"""

from __future__ import annotations

import random
import struct
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
from fuzz_targets import TARGETS, Target, encoded, example, read_bytes_as_file, stored_npz

CONSTANT_BYTES = 400_000
"""What a parser may take for an input of no size: read buffers, JSON, numpy's headers."""
TIMES_INPUT = 4

INTERESTING = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**63 - 1)


def spoil(data: bytes, rng: random.Random) -> bytes:
    """One to six mutations: bytes, bits, numbers that matter, parts taken out, doubled or moved."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(out)) if out else 0
        kind = rng.randrange(7)
        if kind == 0 and out:
            out[at] = rng.randrange(256)
        elif kind == 1 and out:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 2:
            form = rng.choice(["<I", ">I", "<H", ">H", "<Q"])
            word = struct.pack(form, rng.choice(INTERESTING) % 256 ** struct.calcsize(form))
            out[at : at + len(word)] = word
        elif kind == 3:
            del out[at : at + rng.randint(1, 64)]
        elif kind == 4:
            out[at:at] = out[at : at + rng.randint(1, 400)]
        elif kind == 5:
            del out[at:]
        else:
            other = rng.randrange(len(out)) if out else 0
            out[at : at + 8] = out[other : other + 8]
    return bytes(out)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_seeds_are_taken(target: Target) -> None:
    seeds = target.seeds()
    assert seeds, "a target without a whole input is fuzzed blind"
    for seed in seeds:
        target.run(seed)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
@given(seed=st.integers(0, 2**32 - 1), noise=st.binary(max_size=200))
@settings(max_examples=25, deadline=None)
def test_spoiled_input_ends_in_a_value_or_an_error_of_the_tree(
    target: Target, seed: int, noise: bytes
) -> None:
    rng = random.Random(seed)
    target.run(noise)
    for whole in target.seeds():
        spoiled = spoil(whole, rng)[: target.longest]
        target.run(spoiled)


def peak_of(parse: Callable[[], object]) -> int:
    """Bytes taken at the worst moment, as Python and numpy count them."""
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        parse()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


def csv_of_zeros() -> bytes:
    """The least text a sample can be: two bytes become four."""
    head = b"1.0, MrmFullScanInfo, %d, 7, %d, 0, 0, 0, 0, 10000, 522695, 32, 1, 2, 3, 8400"
    return b"1.0, Config, 7\n" + b"".join(head % (n, n) + b",0" * 8400 + b"\n" for n in range(60))


def backwards(packets: bytes) -> bytes:
    parts = [packets[i : i + 1452] for i in range(32, len(packets), 1452)]
    return packets[:32] + b"".join(reversed(parts))


LARGE: dict[str, Callable[[], bytes]] = {
    "recording": lambda: encoded(".prd", example(1152, 400)),
    "recording, scans backwards": lambda: backwards(encoded(".prd", example(350, 1500))),
    "recording, one sample a message": lambda: encoded(".prd", example(1, 1500)),
    "mrm-ret": lambda: encoded(".csv", example(1152, 200)),
    "mrm-ret, zeros": csv_of_zeros,
    "mrm-ret, commas": lambda: b"1.0, Config, 7\n" + b"," * 3_000_000,
    "mrm-ret, detections": lambda: (
        csv_of_zeros()[:20_000] + b"\n" + b"1.0, MrmDetectionListInfo, 1, 1, 4, 5\n" * 8_000
    ),
    "mrm-ret, many radars": lambda: b"".join(
        b"1.0, MrmFullScanInfo, 1, %d, 1, 0, 0, 0, 0, 1, 9, 32, 1, 2, 3, 1, 0\n" % n for n in range(8_000)
    ),
    "journal": lambda: encoded(".tagid.journal", example(1152, 400)),
    "journal, tiny records": lambda: encoded(".tagid.journal", example(bins=1, views=8_000)),
    "journal, one long claim": lambda: (
        encoded(".tagid.journal")[:200] + b"REC\x1e\2\0\0\0" + (60 << 20).to_bytes(4, "little") * 100_000
    ),
    "npz, stored": lambda: stored_npz(example(1152, 400)),
    "hdf5": lambda: encoded(".tagid.h5", example(1152, 400)),
}


@pytest.mark.parametrize("kind", LARGE)
def test_memory_stays_below_four_times_the_input(kind: str) -> None:
    data = LARGE[kind]()
    read_bytes_as_file(data[:5000])  # what is imported late is no part of the measurement
    peak = peak_of(lambda: read_bytes_as_file(data))
    assert peak <= TIMES_INPUT * len(data) + CONSTANT_BYTES, f"{peak / len(data):.2f} times the input"


@pytest.mark.parametrize("name", ["message", "framing-usb", "framing-uart", "regrouping", "recording",
                                  "mrm-ret", "journal", "npz", "hdf5"])  # fmt: skip
def test_memory_stays_small_for_spoiled_input(name: str) -> None:
    target = next(target for target in TARGETS if target.name == name)
    rng = random.Random(11)
    seeds = target.seeds()
    for seed in seeds:
        target.run(seed)
    inputs = [spoil(rng.choice(seeds), rng)[: target.longest] for _ in range(60)]
    for data in inputs:
        peak = peak_of(lambda data=data: target.run(data))
        assert peak <= TIMES_INPUT * len(data) + CONSTANT_BYTES
