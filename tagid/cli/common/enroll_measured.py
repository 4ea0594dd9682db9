"""Enrolling from captures: positions of the reflectors where they are seen, and a signature of the object.

On a metal can or a cup with a handle the body's echo covers the reflectors; the object is then enrolled by
its signature alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tagid.cli.common.frame import Terminal
from tagid.config import Config
from tagid.errors import DataError, UsageError

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.pipeline.settings import ImagingSettings
    from tagid.tags.bodies.joint import Joint
    from tagid.tags.enrolling.averaging import LayoutEstimate


@dataclass(frozen=True)
class Prepared:
    """A capture ready to be measured.

    Attributes:
        name: its file, for messages.
        capture: with angles, one turn.
    """

    name: str
    capture: Capture


@dataclass(frozen=True)
class Measured:
    """What captures of an object gave.

    Attributes:
        estimate: its layout; None if the reflectors' positions are not seen.
        joint: its signature; None if there is none.
        remarks: why one of the two is missing.
    """

    estimate: LayoutEstimate | None
    joint: Joint | None
    remarks: tuple[str, ...] = ()


def prepared(captures: Sequence[Path], config: Config) -> list[Prepared]:
    """Read captures of one object. Raises UsageError if one is given twice."""
    from tagid.pipeline.load import LoadSettings, load_capture

    again = "Give captures of the object repositioned between them."
    if len({path.resolve() for path in captures}) < len(captures):
        raise UsageError("one capture is given twice", again)
    known: dict[str, Path] = {}
    found = []
    loading = LoadSettings.of(config)
    for path in captures:
        capture = load_capture(path, loading)
        twin = known.setdefault(capture.uuid, path)
        if twin != path:
            raise UsageError(f"{path} and {twin} are one capture", again)
        found.append(Prepared(str(path), capture))
    return found


def measure(name: str, captures: Sequence[Path], config: Config, terminal: Terminal) -> Measured:
    """Positions and signature of a tagged object.

    Raises:
        UsageError: a capture is given twice.
        DataError: neither positions nor a signature could be had; both reasons are in the message.
    """
    from tagid.cli.common.imaging import settings_from
    from tagid.pipeline.identify import sight_reflectors
    from tagid.tags.bodies.joint import CAPTURES
    from tagid.tags.enrolling.averaging import average, trusted

    settings = settings_from(config)
    ready = prepared(captures, config)
    seen = []
    with terminal.progress("captures", total=len(ready)) as advance:
        for number, one in enumerate(ready, 1):
            seen.append(sight_reflectors(one.capture, one.name, settings))
            advance(number, Path(one.name).name)
    positions: DataError | None = None
    estimate: LayoutEstimate | None = None
    try:
        estimate = average(seen, name, direction_known=config["tags.direction"] == "known")
    except DataError as error:
        positions = error
    if len(ready) < CAPTURES:
        if positions is not None:
            raise positions
        return Measured(estimate, None, (f"no signature: it needs {CAPTURES} captures",))
    try:
        joint = signature(name, "object", ready, settings, terminal)
    except DataError as error:
        if positions is not None:
            raise DataError(
                f"{positions.message}; and by its signature: {error.message}", error.remedy
            ) from None
        return Measured(estimate, None, (f"positions only, no signature: {error.message}",))
    if estimate is not None:
        doubt = trusted(seen, [one.spectra for one in joint.placed])
        if doubt:
            estimate, positions = None, DataError(doubt)
    if positions is not None:
        reason = positions.message
        return Measured(
            None,
            joint,
            (f"enrolled by its signature: positions of the reflectors cannot be seen ({reason})",),
        )
    return Measured(estimate, joint)


def signature(
    name: str, kind: str, ready: Sequence[Prepared], settings: ImagingSettings, terminal: Terminal
) -> Joint:
    """Signature of a body or object. Raises DataError if its captures do not confirm it."""
    from tagid.pipeline.identify import aspect_spectra
    from tagid.tags.bodies.joint import Named, enrol_signature

    with terminal.progress("signature", total=len(ready) + 1) as advance:
        spectra = []
        for number, one in enumerate(ready, 1):
            try:
                spectra.append(Named(one.name, aspect_spectra(one.capture, settings)))
            except DataError as error:
                raise DataError(f"{one.name}: {error.message}", error.remedy) from None
            advance(number, Path(one.name).name)
        joint = enrol_signature(spectra, name, kind)  # type: ignore[arg-type]
        advance(len(ready) + 1, "estimated")
    return joint


def joint_data(joint: Joint | None) -> dict[str, Any] | None:
    """A joint estimate for scripts."""
    if joint is None:
        return None
    one = joint.signature
    return {
        "kind": one.kind,
        "name": one.name,
        "radius_m": one.radius_m,
        "harmonics": one.order,
        "model_error": one.model_error,
        "noise_share": one.noise_share,
        "captures": [
            {
                "file": residual.name,
                "residual_over_noise": residual.left / residual.expected,
                "unexplained": residual.share,
                "centre_m": list(placed.pose.centre_m),
                "rotation_deg": degrees(placed.pose.turn_rad) % 360,
            }
            for residual, placed in zip(joint.residuals, joint.placed, strict=True)
        ],
    }


def joint_words(joint: Joint) -> list[str]:
    """The same for people, a line per capture."""
    one = joint.signature
    lines = [f"signature: radius {one.radius_m * 1e3:.0f} mm, {one.order} harmonics"]
    for residual, placed in zip(joint.residuals, joint.placed, strict=True):
        x, y = (value * 1e3 for value in placed.pose.centre_m)
        lines.append(
            f"  {Path(residual.name).name}: residual {residual.left / residual.expected:.2f} times noise, "
            f"centre ({x:.1f}, {y:.1f}) mm, turned {degrees(placed.pose.turn_rad) % 360:.0f} deg"
        )
    return lines
