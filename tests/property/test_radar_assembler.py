"""Regrouping under everything that UDP and hostile senders do."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tagid.radar.assembler import MAX_PENDING, MAX_READY, Scan, ScanAssembler
from tagid.radar.scan_info import read_fragment, scan_packets
from tagid.radar.settings import RadarConfig

CONFIG = RadarConfig(scan_start_ps=10_000, scan_stop_ps=60_000)


def samples_of(index: int) -> np.ndarray:
    return np.arange(CONFIG.samples, dtype=np.int32) - 7 * index


def packets_of(count: int, first_id: int, first_ms: int = 1000) -> list[list[bytes]]:
    return [
        scan_packets(samples_of(i), CONFIG, (first_id + i) & 0xFFFF, (first_ms + 16 * i) & 0xFFFFFFFF)
        for i in range(count)
    ]


def feed(assembler: ScanAssembler, packets: list[bytes]) -> list[Scan]:
    out = [scan for packet in packets for scan in assembler.add(read_fragment(packet))]
    return out + assembler.flush()


@given(st.data())
@settings(max_examples=80, deadline=None)
def test_loss_repeats_and_shuffling_cost_only_the_scans_they_hit(data: st.DataObject) -> None:
    """Any small displacement, loss or repeat: exactly the untouched scans come out, in order, once."""
    count = data.draw(st.integers(1, 30))
    first_id = data.draw(st.sampled_from([0, 5, 65_530, 65_535]))
    first_ms = data.draw(st.sampled_from([0, 2**32 - 40]))
    scans = packets_of(count, first_id, first_ms)
    flat = [(i, k) for i, fragments in enumerate(scans) for k in range(len(fragments))]
    lost = data.draw(st.sets(st.sampled_from(flat), max_size=6))
    repeated = data.draw(st.lists(st.sampled_from(flat), max_size=6))
    # Each packet is displaced by less than three scans: within what the assembler must stand.
    per_scan = len(scans[0])
    arrivals = [
        (position + data.draw(st.floats(0, 3 * per_scan)), item)
        for position, item in enumerate(flat)
        if item not in lost
    ]
    arrivals += [(flat.index(item) + 0.5, item) for item in repeated if item not in lost]
    order = [scans[i][k] for _, (i, k) in sorted(arrivals)]
    assembler = ScanAssembler(first_id, clock_ns=lambda: 1)
    got = feed(assembler, order)
    assembler.give_up_until(first_id + count)
    whole = [i for i in range(count) if not any(i == a for a, _ in lost)]
    assert [scan.scan_id - first_id for scan in got] == whole
    for scan in got:
        np.testing.assert_array_equal(scan.samples, samples_of(scan.scan_id - first_id))
    if got:
        steps = np.diff([scan.radar_time_ms for scan in got])
        assert (steps == 16 * np.diff(whole)).all()
    s = assembler.statistics
    assert (s.complete_scans, s.lost_scans) == (len(whole), count - len(whole))
    assert s.duplicate + s.late == len([item for item in repeated if item not in lost])


def test_same_id_of_another_time_is_another_scan() -> None:
    """A fragment of an old run with the same id must not be mixed into a scan."""
    old = scan_packets(samples_of(99), CONFIG, 3, 500)
    new = scan_packets(samples_of(0), CONFIG, 3, 9000)
    (scan,) = feed(ScanAssembler(3), [old[0], new[1], new[2], new[0]])
    np.testing.assert_array_equal(scan.samples, samples_of(0))


def test_an_id_that_runs_ahead_of_the_clock_is_damage_and_costs_nothing_else() -> None:
    """USB frames have no checksum: one flipped bit in an id must not make all that follows look late."""
    assembler = ScanAssembler(0, period_s=CONFIG.scan_period_s)
    scans = packets_of(40, 0)
    damaged = bytearray(scans[5][1])
    damaged[2] ^= 0x40
    flat = [packet for scan in scans for packet in scan]
    flat[flat.index(scans[5][1])] = bytes(damaged)
    got = feed(assembler, flat)
    assert [scan.scan_id for scan in got] == [i for i in range(40) if i != 5]
    assert (assembler.statistics.malformed, assembler.statistics.late) == (1, 0)


def test_a_gap_in_ids_that_the_clock_confirms_is_a_gap() -> None:
    assembler = ScanAssembler(0, period_s=CONFIG.scan_period_s)
    scans = [*packets_of(20, 0)[:2], scan_packets(samples_of(5000), CONFIG, 5000, 1000 + 16 * 5000)]
    assert [scan.scan_id for scan in feed(assembler, [p for s in scans for p in s])] == [0, 1, 5000]
    assert assembler.statistics.lost_scans == 4998


def test_a_fragment_that_contradicts_its_scan_is_dropped_and_the_scan_still_comes() -> None:
    """Same id and time, but another window: it must neither be mixed in nor stop the rest."""
    good = scan_packets(samples_of(0), CONFIG, 3, 500)
    other = RadarConfig(scan_start_ps=12_000, scan_stop_ps=62_000)
    assert other.samples == CONFIG.samples
    alien = scan_packets(samples_of(7), other, 3, 500)
    assembler = ScanAssembler(3)
    (scan,) = feed(assembler, [good[0], alien[1], alien[2], *good[1:]])
    np.testing.assert_array_equal(scan.samples, samples_of(0))
    assert assembler.statistics.malformed == 2
    assert assembler.statistics.duplicate == 0


def test_unfinished_scans_take_bounded_memory_and_the_oldest_goes() -> None:
    """Without its first fragment no scan is ever whole; a hostile sender does this for hours."""
    assembler = ScanAssembler(0)
    for i in range(MAX_PENDING + 40):
        assert assembler.add(read_fragment(scan_packets(samples_of(i), CONFIG, 5, i)[1])) == []
        assert len(assembler._pending) == min(i + 1, MAX_PENDING)
    times = [time_ms for _, time_ms in assembler._pending]
    assert times == list(range(40, MAX_PENDING + 40))


def test_whole_scans_wait_in_bounded_memory_for_one_that_never_comes() -> None:
    """All stamps are the same, so that time never gives up the missing scan: the bound does."""
    assembler = ScanAssembler(0)
    out: list[Scan] = []
    for i in range(1, MAX_READY + 1):
        for packet in scan_packets(samples_of(i), CONFIG, i, 77):
            out += assembler.add(read_fragment(packet))
        assert len(assembler._ready) <= MAX_READY
    assert [scan.scan_id for scan in out] == list(range(1, MAX_READY + 1))
    assert assembler.statistics.lost_scans == 1
    assert assembler.whole_scans == MAX_READY


def test_a_missing_scan_is_waited_for_until_both_window_and_time_are_over() -> None:
    """Eight scans must have overtaken it, and 100 ms of the radar's clock have passed since the first did."""

    def first_out(step_ms: int) -> int:
        assembler = ScanAssembler(0)
        for i in range(1, 200):
            stamp = i * step_ms
            if any(assembler.add(read_fragment(p)) for p in scan_packets(samples_of(i), CONFIG, i, stamp)):
                return i
        return -1

    assert first_out(50) == 8  # the window decides
    assert first_out(10) == 11  # 100 ms after scan 1
    assert first_out(1) == 101


def test_scans_within_the_window_of_the_newest_are_still_waited_for() -> None:
    """After 9 and 10, scans 3 to 8 may still arrive; only those before are lost."""
    assembler = ScanAssembler(0)
    for i in (9, 10, *range(3, 9)):
        packets = scan_packets(samples_of(i), CONFIG, i, 200 * i)
        out = [scan for packet in packets for scan in assembler.add(read_fragment(packet))]
    assert assembler.statistics.lost_scans == 3
    assert [scan.scan_id for scan in out] == [8, 9, 10]


def test_a_scan_carries_all_that_its_fragments_say() -> None:
    config = RadarConfig(scan_start_ps=11_000, scan_stop_ps=71_000, antenna_mode=3, node_id=77)
    samples = np.arange(config.samples, dtype=np.int32) * 1001 - 5
    times = iter([111, 222, 333])
    assembler = ScanAssembler(9, clock_ns=lambda: next(times))
    assert assembler.next_id == 9
    out = []
    for packet in scan_packets(samples, config, 9, 4_000_000_000):
        assert assembler.newest_id == (9 if out or assembler.newest_id else None)
        out += assembler.add(read_fragment(packet))
    (scan,) = out
    assert (scan.scan_id, scan.radar_time_ms, scan.host_time_ns) == (9, 4_000_000_000, 111)
    assert (scan.scan_start_ps, scan.scan_stop_ps) == (11_000, config.scan_stop_ps)
    assert (scan.antenna_id, scan.node_id) == (3, 77)
    np.testing.assert_array_equal(scan.samples, samples)
    assert scan.samples.dtype == np.int32 and not scan.samples.flags.writeable
    assert (assembler.next_id, assembler.newest_id, assembler.whole_scans) == (10, 9, 1)
    assert assembler.statistics.complete_scans == 1


def test_a_repeated_fragment_is_a_duplicate_and_one_of_the_past_is_late() -> None:
    assembler = ScanAssembler(0)
    first, second, third = packets_of(3, 0)
    for packet in [first[0], first[0], *second, second[0]]:  # before its scan is whole, and after
        assert assembler.add(read_fragment(packet)) == []
    assert (assembler.statistics.duplicate, assembler.statistics.late) == (2, 0)
    done = [scan.scan_id for packet in first[1:] for scan in assembler.add(read_fragment(packet))]
    assert done == [0, 1]
    assert assembler.add(read_fragment(second[1])) == []
    assert (assembler.statistics.duplicate, assembler.statistics.late) == (2, 1)
    assert assembler.newest_id == 1
    assembler.add(read_fragment(third[0]))
    assert (assembler.newest_id, assembler.next_id) == (2, 2)


def test_a_run_without_a_first_id_begins_with_the_first_that_is_seen() -> None:
    assembler = ScanAssembler()
    assert assembler.next_id is None and assembler.newest_id is None
    assembler.give_up_until(4)
    assert assembler.statistics.lost_scans == 0
    packets = [packet for scan in packets_of(2, 500) for packet in scan]
    assert [scan.scan_id for scan in feed(assembler, packets)] == [500, 501]
    assembler.give_up_until(502)
    assembler.give_up_until(400)
    assert assembler.statistics.lost_scans == 0
    assembler.give_up_until(505)
    assert (assembler.statistics.lost_scans, assembler.next_id) == (3, 505)


def test_scans_given_up_at_the_end_take_their_fragments_with_them() -> None:
    assembler = ScanAssembler(0)
    scans = packets_of(4, 0)
    for packet in [scans[0][0], scans[1][0], scans[3][0]]:
        assembler.add(read_fragment(packet))
    assembler.give_up_until(3)
    assert [scan_id for scan_id, _ in assembler._pending] == [3]
    assert [scan.scan_id for p in scans[3][1:] for scan in assembler.add(read_fragment(p))] == [3]
    assert not assembler._pending


def test_how_far_an_id_may_run_ahead_of_the_clock() -> None:
    """64 scans, and twice what the time between the stamps holds; a stamp before the first says nothing."""
    period_s = 0.01

    def taken(scan_id: int, elapsed_ms: int) -> bool:
        assembler = ScanAssembler(10, period_s=period_s)
        start = 2**32 - 20  # the clock wraps in between
        for packet in scan_packets(samples_of(0), CONFIG, 10, start):
            assembler.add(read_fragment(packet))
        late = (start + elapsed_ms) % 2**32
        assembler.add(read_fragment(scan_packets(samples_of(1), CONFIG, scan_id, late)[0]))
        assert assembler.statistics.malformed + len(assembler._pending) == 1
        return bool(assembler._pending)

    assert taken(10 + 64, 0) and not taken(10 + 65, 0)
    assert taken(10 + 64 + 20, 100) and not taken(10 + 64 + 21, 100)
    assert taken(10 + 3000, -1)


def test_the_clock_of_scans_out_of_order_goes_back_without_a_wrap() -> None:
    """Stamps are unwrapped beside the newest one, so that an older scan may come after the wrap."""
    assembler = ScanAssembler(0)
    stamps = [2**32 - 30, 2**32 - 10, 10, 30]
    scans = [scan_packets(samples_of(i), CONFIG, i, stamp % 2**32) for i, stamp in enumerate(stamps)]
    got = [scan for i in (0, 2, 1, 3) for p in scans[i] for scan in assembler.add(read_fragment(p))]
    assert [scan.radar_time_ms - 2**32 for scan in got] == [-30, -10, 10, 30]


def test_a_radar_that_paused_for_weeks_goes_on_on_the_same_clock() -> None:
    """Half of the 32-bit clock, 24.8 days, is the longest pause that is told from a step back."""
    pause = 2**30 + 5000
    packets = scan_packets(samples_of(0), CONFIG, 3, 1000)
    packets += scan_packets(samples_of(1), CONFIG, 4, 1000 + pause)
    assert [scan.radar_time_ms for scan in feed(ScanAssembler(3), packets)] == [1000, 1000 + pause]
