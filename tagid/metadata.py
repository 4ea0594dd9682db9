"""The metadata of a capture: its radar, its motion and its object, as frozen, validated values.

This is the only place that spells the keys. `from_json` and `to_json` convert to the JSON objects
that files hold; keys that no field has are kept in `extra`, so a file of another program loses nothing.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from functools import cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tagid.constants import CLIP_COUNTS_PER_INTEGRATION
from tagid.errors import DataError

METADATA_VERSION = 2
"""Version of the JSON objects. 1: untyped, before 0.2.0 (`tagid.storage.metadata` reads it)."""

_LARGEST_INTEGRATION_INDEX = 15
"""Largest base integration index of a P440 (MRM API: 6..15); a larger number in a file is not believed."""


class JsonValue:
    """A frozen dataclass that is a JSON object in files."""

    def __post_init__(self) -> None:
        for name, kind in _kinds(type(self)).items():
            value = getattr(self, name)
            # Most fields of most captures are not known, which every optional field may be.
            if not (value is None and _optional(kind)) and not _fits(value, kind):
                raise DataError(f"{_label(type(self))}.{name} is {_short(value)}, expected {_words(kind)}")

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """The value of a JSON object; unknown keys go to `extra`.

        Raises DataError if a known key holds something of another type.
        """
        known: dict[str, Any] = {}
        extra: dict[str, Any] = {}
        kinds = _kinds(cls)
        for key, value in values.items():
            if key in kinds and key != "extra":
                known[key] = _decoded(value, kinds[key], f"{_label(cls)}.{key}")
            else:
                extra[key] = value
        if extra and "extra" not in kinds:
            raise DataError(f"{_label(cls)} has no field {next(iter(extra))!r}")
        needed = {item.name for item in fields(cls) if _required(item)}  # type: ignore[arg-type]
        if missing := sorted(needed - set(known)):
            raise DataError(f"{_label(cls)} lacks {', '.join(missing)}")
        return cls(**known, **({"extra": extra} if extra else {}))

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; fields that are not known are absent."""
        values: dict[str, Any] = {}
        for item in fields(self):  # type: ignore[arg-type]
            value = getattr(self, item.name)
            if item.name != "extra" and not _unknown(value):
                values[item.name] = _encoded(value)
        return {**values, **getattr(self, "extra", {})}


@dataclass(frozen=True)
class RadarSettings(JsonValue):
    """The configuration block of a P440 as a recording holds it; a field is None if it is not known.

    Not limited to what a P440 accepts: `tagid.radar.settings.RadarConfig` is the validated counterpart.

    Attributes:
        scan_start_ps, scan_stop_ps: two-way time of the scan window, ps.
        node_id: number of the radar.
        base_integration_index: 2^index pulses are summed into a sample.
        antenna_mode, transmit_gain, code_channel, persist: as in the P440 MRM API.
        resolution_bins: bins of 1.907 ps between samples.
        segment_samples, segment_multiplier: four each; not implemented in the radar.
    """

    scan_start_ps: int | None = None
    scan_stop_ps: int | None = None
    node_id: int | None = None
    base_integration_index: int | None = None
    antenna_mode: int | None = None
    transmit_gain: int | None = None
    code_channel: int | None = None
    persist: int | None = None
    resolution_bins: int | None = None
    segment_samples: tuple[int, ...] | None = None
    segment_multiplier: tuple[int, ...] | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def clip_counts(self) -> int | None:
        """Amplitude at which a sample saturates, counts: 127 * 2^index (measured); None if not known."""
        index = self.base_integration_index
        if index is None or not 0 <= index <= _LARGEST_INTEGRATION_INDEX:
            return None
        return CLIP_COUNTS_PER_INTEGRATION << index


@dataclass(frozen=True)
class ScanGap(JsonValue):
    """A time without scans inside a recording.

    Attributes:
        after_scan: number of the last scan before it.
        seconds: its length, on the radar's clock where that continued, else on the host's.
        reason: what happened.
        restarted: whether the radar's clock restarted.
    """

    after_scan: int
    seconds: float
    reason: str
    restarted: bool


@dataclass(frozen=True)
class ReferenceFacts(JsonValue):
    """Statistics of a recording of the empty scene.

    Attributes:
        noise_std: standard deviation of the noise of a sample, counts.
        scans: number of scans averaged.
        rms: root mean square of the mean scan, counts.
    """

    noise_std: float
    scans: int
    rms: float


@dataclass(frozen=True)
class ReferenceName(JsonValue):
    """Which recording of the empty scene was subtracted."""

    uuid: str
    created_utc: str


@dataclass(frozen=True)
class RecordingPart(JsonValue):
    """The place of a capture file in a recording of several files: part `part` of `parts`, from 1."""

    uuid: str
    part: int
    parts: int


@dataclass(frozen=True)
class Ending(JsonValue):
    """Why a recording ended where nothing failed.

    Attributes:
        reason: "turn": a turn and the overlap were complete; "limit": the number of scans or the time was
            reached; "sure": the answer was certain enough before the turn was complete.
        share: of the turn that the decision rests on, 0..1; with "sure" only, like the following.
        layout: the layout that was named.
        p_value: bound on the probability of such a name for an object without an enrolled tag, and
        turns: number of calibration turns that it rests on.
        spent: share of the false-accept probability that readings during the recording have used, where
            they did not end it; the reading of the whole has the rest.
    """

    reason: str
    share: float | None = None
    layout: str | None = None
    p_value: float | None = None
    turns: int | None = None
    spent: float | None = None


@dataclass(frozen=True)
class RadarInfo(JsonValue):
    """The radar of a capture and what happened while it recorded.

    Attributes:
        source: format of the imported file; None for a recording of tagid's own.
        kind: "simulated" if there was no radar.
        serial, package: serial number and hardware package as the radar reports them.
        node_id: number of the radar in an imported file.
        config: settings in force.
        config_asked: requested settings, if they differ in origin.
        cable_delay_ps: two-way delay subtracted from the ranges, ps.
        scan_info: other fields of the first scan, by the names of the P440's message.
        statistics: counters of the client by name.
        scans_lost: number of scans that did not arrive completely.
        scans_dropped: number of scans dropped because the disk was too slow.
        gap_count, gaps: times without scans; at most the first hundred are listed.
        journal_bytes_dropped, bytes_left_over: bytes that belong to no intact record.
        packets_ignored: messages or lines that are not scans of this radar.
        ignored: what of a file is not used, one phrase each, e.g. "254 filtered scans of the same radar".
        config_stale: whether the file's configuration does not match its scans.
        window_requested_ps, window_actual_ps: window of the configuration and of the scans in that case, ps.
        detection_lists: the vendor's detections, one text per scan.
        reference: statistics, where this is a recording of the empty scene.
        background_reference: the recording of the empty scene that was subtracted.
        recording: part of a recording in several files.
        ended: why the recording ended; None if it was interrupted, or is not of a turn.
        seed: of a simulation.
        extra: other keys of the file.
    """

    source: str | None = None
    kind: str | None = None
    serial: str | int | None = None
    package: str | None = None
    node_id: int | None = None
    config: RadarSettings | None = None
    config_asked: RadarSettings | None = None
    cable_delay_ps: float | None = None
    scan_info: Mapping[str, Any] | None = None
    statistics: Mapping[str, float] | None = None
    scans_lost: int | None = None
    scans_dropped: int | None = None
    gap_count: int | None = None
    gaps: tuple[ScanGap, ...] = ()
    journal_bytes_dropped: int | None = None
    bytes_left_over: int | None = None
    packets_ignored: int | None = None
    ignored: tuple[str, ...] = ()
    config_stale: bool | None = None
    window_requested_ps: tuple[int, ...] | None = None
    window_actual_ps: tuple[int, ...] | None = None
    detection_lists: tuple[str, ...] = ()
    reference: ReferenceFacts | None = None
    background_reference: ReferenceName | None = None
    recording: RecordingPart | None = None
    ended: Ending | None = None
    seed: int | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    def with_known(self, other: RadarInfo) -> RadarInfo:
        """The same with every field that `other` knows."""
        known = {item.name: getattr(other, item.name) for item in fields(other) if item.name != "extra"}
        return replace(self, **{name: value for name, value in known.items() if not _unknown(value)})

    @property
    def clip_counts(self) -> int | None:
        """Amplitude at which a sample saturates, counts; None if the integration is not known."""
        return None if self.config is None else self.config.clip_counts


@dataclass(frozen=True)
class Standstill(JsonValue):
    """A part of a recording in which the object stood still although it should have turned.

    Attributes:
        first_scan: index of its first scan.
        scans, of_scans: its number of scans, and that of the recording.
        seconds: its duration, s.
        turned_deg: angle at which the object stopped, not negative; None where the speed is not known.
        goes_on: whether the object turned again afterwards.
    """

    first_scan: int
    scans: int
    of_scans: int
    seconds: float
    turned_deg: float | None = None
    goes_on: bool = False


@dataclass(frozen=True)
class ResolvedMotion(JsonValue):
    """How the angles of a capture were found.

    Attributes:
        kind: what turned the object, e.g. "free" or "roomba".
        source: "data", "nominal", "measured" or "simulated".
        direction: +1 counter-clockwise from above, -1 clockwise.
        turns: number of turns recorded.
        period_s, period_sigma_s: time per turn and its standard deviation, s.
        quality: 0..1, how well the scans repeat after a period.
        repeats: False where the scans show that they do not repeat after the stated period; else None.
        nominal_rpm: the stated speed, turns per minute.
        measured_rpm: the speed that the scans show, where it contradicts the stated one.
        likely_rpms: the speeds that they may show instead, where a symmetric tag does not tell them apart.
        harmonic_ambiguous: whether a multiple of the period explains the scans as well.
        reason: why the data were not used.
        shortest_repetition_s, repetitions_a_turn, unexplained: see `tagid.pipeline.turn`.
        scan_period_s, clock_residual_ms: of the radar's clock.
        checked_by_radar, radar_turn_in_own_rad, radar_turn_sigma_rad, scale, scale_sigma: how a device's own
            angles compare with the repetition of the scans.
        clock_drift_ppm, radar_arrival_residual_ms, motion_arrival_residual_ms, clock_sigma_ms,
            scans_outside_motion: alignment of the device's clock with the radar's.
        robot, wheel_base_mm, calibrated: of a Roomba.
        table: device of a commanded table.
        reversed: whether its directions are swapped.
        standstill: where the scans show that the object stopped; its angle is held there.
        extra: what else the device reports.
    """

    kind: str | None = None
    source: str | None = None
    direction: int | None = None
    turns: float | None = None
    period_s: float | None = None
    period_sigma_s: float | None = None
    quality: float | None = None
    repeats: bool | None = None
    nominal_rpm: float | None = None
    measured_rpm: float | None = None
    likely_rpms: tuple[float, ...] = ()
    harmonic_ambiguous: bool | None = None
    reason: str | None = None
    shortest_repetition_s: float | None = None
    repetitions_a_turn: int | None = None
    unexplained: Mapping[str, float] | None = None
    scan_period_s: float | None = None
    clock_residual_ms: float | None = None
    checked_by_radar: bool | None = None
    radar_turn_in_own_rad: float | None = None
    radar_turn_sigma_rad: float | None = None
    scale: float | None = None
    scale_sigma: float | None = None
    clock_drift_ppm: float | None = None
    radar_arrival_residual_ms: float | None = None
    motion_arrival_residual_ms: float | None = None
    clock_sigma_ms: float | None = None
    scans_outside_motion: int | None = None
    robot: str | None = None
    wheel_base_mm: float | None = None
    calibrated: bool | None = None
    table: str | None = None
    reversed: bool | None = None
    standstill: Standstill | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def shown_rpms(self) -> tuple[float, ...]:
        """Speeds that contradict the stated one, likeliest first; empty if none does."""
        shown = (self.measured_rpm,) if self.measured_rpm else self.likely_rpms
        return tuple(rpm for rpm in shown if 0 < rpm < math.inf)


@dataclass(frozen=True, eq=False)
class Track(JsonValue):
    """Angles as a device measured them.

    Attributes:
        host_time_ns: (readings,) int64 when the reading reached this computer, ns since the epoch.
        angles_rad: (readings,) object angle since the start, counter-clockwise from above, rad.
        sigma_rad: (readings,) standard deviation of an angle but for a common factor, rad.
        info: `kind`; `scale_sigma`, the relative standard deviation of a factor common to all angles;
            `step_s`, the device's own time between readings, where it is even; whatever else is known.
    """

    host_time_ns: NDArray[np.int64]
    angles_rad: NDArray[np.float64]
    sigma_rad: NDArray[np.float64]
    info: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.host_time_ns)
        for name in ("host_time_ns", "angles_rad", "sigma_rad"):
            value = getattr(self, name)
            if value.shape != (n,) or not np.isfinite(value).all():
                raise DataError(f"{name} of a motion track has shape {value.shape}, expected ({n},), finite")

    def __len__(self) -> int:
        return len(self.host_time_ns)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Track) and self.to_json() == other.to_json()

    def __hash__(self) -> int:
        return hash((len(self), float(self.angles_rad.sum()) if len(self) else 0.0))

    @classmethod
    def of(cls, readings: typing.Sequence[tuple[int, float, float]], info: Mapping[str, Any]) -> Track:
        """A track of (host_time_ns, angle_rad, sigma_rad)."""
        return cls(
            np.array([r[0] for r in readings], dtype=np.int64),
            np.array([r[1] for r in readings], dtype=np.float64),
            np.array([r[2] for r in readings], dtype=np.float64),
            dict(info),
        )

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Track:
        """The track of a JSON object. Raises DataError."""
        try:
            return cls(
                np.asarray(values["host_time_ns"], dtype=np.int64),
                np.asarray(values["angle_rad"], dtype=np.float64),
                np.asarray(values["sigma_rad"], dtype=np.float64),
                dict(values.get("info") or {}),
            )
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError, IndexError):
            raise DataError("the capture's motion track is damaged", "Use `motion.url=free`.") from None

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "host_time_ns": self.host_time_ns.tolist(),
            "angle_rad": self.angles_rad.tolist(),
            "sigma_rad": self.sigma_rad.tolist(),
            "info": dict(self.info),
        }


@dataclass(frozen=True)
class MotionInfo(JsonValue):
    """What turned the object of a capture, and what is known of its angles.

    Attributes:
        url: device URL, without secrets.
        kind: "simulated" where nothing turned.
        nominal_rpm: stated speed of an imported recording, turns per minute.
        resolved: how the angles were found; None if they were not, or came with the file.
        not_resolved: why those that the device measured could not be assigned to the scans.
        track: the device's own readings, until angles are made of them.
        averaged_into_views: number of views that scans were averaged into.
        extra: other keys of the file.
    """

    url: str | None = None
    kind: str | None = None
    nominal_rpm: float | None = None
    resolved: ResolvedMotion | None = None
    not_resolved: str | None = None
    track: Track | None = None
    averaged_into_views: int | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    def without_track(self, **changes: Any) -> MotionInfo:
        """The same without the device's readings, and with changes."""
        return replace(self, track=None, **changes)


@dataclass(frozen=True)
class SimulatedTruth(JsonValue):
    """How a simulated object was recorded, for those who check an answer; no reading command uses it.

    Attributes:
        rotation_deg, centre_m, elevation_m: pose of the object: rotation, (x, y) off the axis, height.
        axis_distance_m: true distance of the axis.
        wobble_speed, wobble_radial_m: relative amplitude of the speed's wobble, and of the axis, m.
        pulse: "nominal" or "other".
        noise_colour: slope of the noise's spectrum.
        snr_db: SNR of the changing echo, dB; None if nothing changes.
        snr_reflector_db, snr_summed_db: peak per reflector and of all over the noise, dB; None without a tag.
        snr_reference_db: the same of a whole object or another reference, where neither of these is known.
        extra: what else was varied.
    """

    rotation_deg: float | None = None
    centre_m: tuple[float, ...] | None = None
    elevation_m: float | None = None
    axis_distance_m: float | None = None
    wobble_speed: float | None = None
    wobble_radial_m: float | None = None
    pulse: str | None = None
    noise_colour: float | None = None
    snr_reflector_db: float | None = None
    snr_summed_db: float | None = None
    snr_reference_db: float | None = None
    snr_db: float | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ObjectInfo(JsonValue):
    """What is known of the object of a capture.

    Attributes:
        label: name of an imported object.
        note: the operator's remark.
        scene: name of a simulated scene.
        layout: layout that a simulated object carries.
        body, reflector: of a simulated object, as the command line names them.
        seed: of a simulated scene.
        reflectors_m: true (x, y) of the reflectors of a solved object, m.
        snr_reference: what the SNR of a solved object refers to.
        demo: whether an emulated radar recorded it.
        truth: true values of a simulation.
        extra: other keys of the file.
    """

    label: str | None = None
    note: str | None = None
    scene: str | None = None
    layout: str | None = None
    body: str | None = None
    reflector: str | None = None
    seed: int | None = None
    reflectors_m: tuple[tuple[float, ...], ...] | None = None
    snr_reference: str | None = None
    demo: bool | None = None
    truth: SimulatedTruth | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)


_KINDS: dict[type, dict[str, Any]] = {}


def _kinds(cls: type) -> dict[str, Any]:
    """Type of each field; resolved once per class, since a hint is a text until then."""
    if cls not in _KINDS:
        hints = typing.get_type_hints(cls)
        _KINDS[cls] = {item.name: hints[item.name] for item in fields(cls)}
    return _KINDS[cls]


@cache
def _optional(kind: Any) -> bool:
    """Whether a field of this type may be None."""
    return _fits(None, kind)


def _unknown(value: Any) -> bool:
    return value is None or (isinstance(value, tuple) and not value)


def _required(item: Field[Any]) -> bool:
    return item.default is MISSING and item.default_factory is MISSING


def _label(cls: type) -> str:
    return {"RadarInfo": "radar", "MotionInfo": "motion", "ObjectInfo": "object"}.get(
        cls.__name__, cls.__name__
    )


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a field's type; NaN and infinities are not numbers here."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return True
    if origin is types.UnionType or origin is typing.Union:
        return any(_fits(value, option) for option in inner)
    if kind is type(None):
        return value is None
    if kind is bool:
        return isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(item, inner[0]) for item in value)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(
            isinstance(key, str) and _fits(item, inner[1]) for key, item in value.items()
        )
    return isinstance(value, kind)


# msgspec would take the 25 lines of the next two functions, for 696 KB and 11 ms at every start.
def _decoded(value: Any, kind: Any, where: str) -> Any:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType or origin is typing.Union:
        if value is None:
            return None
        rest = [option for option in inner if option is not type(None)]
        fitting = [option for option in rest if _fits(value, option)]
        return _decoded(value, (fitting or rest)[0], where)
    if origin is tuple and isinstance(value, list | tuple):
        return tuple(_decoded(item, inner[0], where) for item in value)
    if is_dataclass(kind) and isinstance(kind, type) and issubclass(kind, JsonValue):
        if not isinstance(value, Mapping):
            raise DataError(f"{where} is {_short(value)}, expected an object")
        return kind.from_json(value)
    if not _fits(value, kind):
        raise DataError(f"{where} is {_short(value)}, expected {_words(kind)}")
    return value


def _encoded(value: Any) -> Any:
    if isinstance(value, JsonValue):
        return value.to_json()
    if isinstance(value, tuple):
        return [_encoded(item) for item in value]
    return dict(value) if isinstance(value, Mapping) else value


def _words(kind: Any) -> str:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType or origin is typing.Union:
        return " or ".join(_words(option) for option in inner if option is not type(None))
    if origin is tuple:
        return f"a list of {_words(inner[0])}"
    if origin is Mapping or (isinstance(kind, type) and issubclass(kind, JsonValue)):
        return "an object"
    return {int: "a whole number", float: "a finite number", str: "a text", bool: "true or false"}.get(
        kind, getattr(kind, "__name__", str(kind))
    )


def _short(value: Any) -> str:
    return repr(value)[:60]
