"""A layout is data: the reflector positions of one identity on its object.

It is validated when made, whether it comes from the package, a user's file or the command line, so that
matcher and registry can rely on every field.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import FileFormatError, TagidError, UsageError
from tagid.files import parse_json, parse_toml, read_bytes

KINDS = ("helmet", "container", "other")
MAX_REFLECTORS = 16
MAX_RADIUS_M = 1.0
KIND_RADIUS_M = {"helmet": 0.2, "container": 0.35, "other": MAX_RADIUS_M}
"""Largest distance of a reflector from the axis by kind: long helmets measure 0.35 m, a 200-litre drum has
a radius of 0.29 m."""
MIN_SPACING_M = 0.02
"""Reflectors closer than this are not resolved: the null of the point response J0(2kr) is at 14.5 mm, and the
paper's octahedra have a size of 40 mm, tip to tip."""
SYMMETRY_TOLERANCE_M = 1e-3
MAX_FILE_BYTES = 64 * 1024
MAX_TEXT = 2000
_SLUG = re.compile(r"[a-z0-9](?:[a-z0-9._-]{0,62}[a-z0-9])?")
MAX_HEIGHT_M = 1.0
MAX_SIGMA_M = 0.1
_FIELDS = ("name", "kind", "positions_m", "heights_m", "covariance_m2", "symmetry", "notes", "label")


def is_name(text: object) -> bool:
    """Whether a text can name a layout, a body or an object.

    >>> is_name("mug-3"), is_name("Mug 3")
    (True, False)
    """
    return isinstance(text, str) and _SLUG.fullmatch(text) is not None


def rotation_matrix(angle_rad: float | NDArray[np.floating]) -> NDArray[np.float64]:
    """(..., 2, 2) matrices R with R @ p = p rotated counter-clockwise by the angle."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    out = np.empty((*np.shape(c), 2, 2))
    out[..., 0, 0] = out[..., 1, 1] = c
    out[..., 0, 1], out[..., 1, 0] = -s, s
    return out


def rotational_symmetry(positions: NDArray[np.float64]) -> int:
    """Largest n for which a rotation by 360/n degrees about z maps points (K, 2) or (K, 3) onto themselves.

    >>> rotational_symmetry(np.array([[0.1, 0.0], [-0.1, 0.0]]))
    2
    """
    for order in range(len(positions), 1, -1):
        turned = positions.copy()
        turned[:, :2] = positions[:, :2] @ rotation_matrix(2 * np.pi / order).T
        gap = np.linalg.norm(turned[:, None] - positions[None], axis=2)
        if (gap.min(axis=1) <= SYMMETRY_TOLERANCE_M).all():
            return order
    return 1


@dataclass(frozen=True, eq=False)
class Layout:
    """Reflector positions of one identity.

    Attributes:
        name: lower-case slug, the identity's key.
        positions: (K, 2) float64, m, in the object's plane; the origin is the object's rotation axis.
        kind: "helmet", "container" or "other".
        symmetry: rotational order n (a rotation by 360/n degrees changes nothing); 0: compute it.
        notes, label: free text.
        heights: (K,) float64, m, of the reflectors above the object's plane; None if all are in it.
        covariance: (K, 2, 2) float64, m^2, of each reflector's position if it was measured; None if the
            positions are nominal.
    """

    name: str
    positions: NDArray[np.float64]
    kind: str = "other"
    symmetry: int = 0
    notes: str = ""
    label: str = ""
    heights: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if not is_name(self.name):
            raise UsageError(
                f"layout name {str(self.name)[:80]!r} is not valid",
                "Use 1 to 64 of a-z, 0-9, dot, dash and underscore; begin and end with a letter or digit.",
            )
        if self.kind not in KINDS:
            raise UsageError(
                f"layout {self.name}: kind {str(self.kind)[:80]!r} is unknown",
                f"Use one of {', '.join(KINDS)}.",
            )
        for name in ("notes", "label"):
            text = getattr(self, name)
            if not isinstance(text, str) or len(text) > MAX_TEXT:
                raise UsageError(f"layout {self.name}: {name} is not text of up to {MAX_TEXT} characters")
            if not all(character.isprintable() or character == "\n" for character in text):
                raise UsageError(
                    f"layout {self.name}: {name} holds control characters",
                    "Use letters, digits and punctuation.",
                )
        object.__setattr__(self, "positions", self._checked_positions())
        object.__setattr__(self, "heights", self._checked_heights())
        object.__setattr__(self, "covariance", self._checked_covariance())
        computed = rotational_symmetry(self._in_space())
        if isinstance(self.symmetry, bool) or not isinstance(self.symmetry, int):
            raise UsageError(f"layout {self.name}: symmetry is not a whole number")
        if self.symmetry not in (0, computed):
            raise UsageError(
                f"layout {self.name}: symmetry is {self.symmetry}, but its positions have {computed}",
                "Omit symmetry to have it computed.",
            )
        object.__setattr__(self, "symmetry", computed)

    def _checked_positions(self) -> NDArray[np.float64]:
        try:
            positions = np.array(self.positions, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise UsageError(
                f"layout {self.name}: positions are not pairs of numbers",
                "Give each reflector as [x, y] in metres.",
            ) from None
        wrong = ""
        if positions.ndim != 2 or positions.shape[1] != 2:
            wrong = f"positions have shape {positions.shape}, expected (K, 2)"
        elif not 2 <= len(positions) <= MAX_REFLECTORS:
            wrong = f"{len(positions)} positions given"
        if wrong:
            raise UsageError(
                f"layout {self.name}: {wrong}", f"Give 2 to {MAX_REFLECTORS} reflectors as [x, y] in metres."
            )
        if not np.isfinite(positions).all():
            raise UsageError(
                f"layout {self.name}: a position is not finite",
                "Give finite numbers of metres.",
            )
        if np.abs(positions).max() > MAX_RADIUS_M:
            raise UsageError(
                f"layout {self.name}: a reflector is over {MAX_RADIUS_M:g} m from the axis",
                "Give positions in metres, not millimetres.",
            )
        gap = np.linalg.norm(positions[:, None] - positions[None], axis=2) + np.eye(len(positions))
        if gap.min() < MIN_SPACING_M:
            raise UsageError(
                f"layout {self.name}: two reflectors are {gap.min() * 1e3:.1f} mm apart",
                f"Place reflectors at least {MIN_SPACING_M * 1e3:.0f} mm apart; closer ones look like one.",
            )
        positions.setflags(write=False)
        return positions

    def _checked_heights(self) -> NDArray[np.float64]:
        try:
            given = np.zeros(self.size) if self.heights is None else np.array(self.heights, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            given = np.full(1, np.nan)
        if given.shape != (self.size,) or not np.isfinite(given).all() or np.abs(given).max() > MAX_HEIGHT_M:
            raise UsageError(
                f"layout {self.name}: heights_m is not one height of up to {MAX_HEIGHT_M:g} m per reflector",
                "Give one height per reflector, in metres, or omit them.",
            )
        given.setflags(write=False)
        return given

    def _checked_covariance(self) -> NDArray[np.float64] | None:
        if self.covariance is None:
            return None
        try:
            given = np.array(self.covariance, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            given = np.full(1, np.nan)
        sound = given.shape == (self.size, 2, 2) and bool((np.abs(given) <= MAX_SIGMA_M**2).all())
        if sound:
            values = np.linalg.eigvalsh(given)
            even = np.allclose(given, np.swapaxes(given, 1, 2), rtol=1e-9, atol=1e-15)
            sound = even and bool((values >= -1e-12).all() and (values <= MAX_SIGMA_M**2).all())
        if not sound:
            raise UsageError(
                f"layout {self.name}: covariance_m2 is not one covariance of up to ({MAX_SIGMA_M:g} m)^2 "
                "a reflector",
                "Give [xx, xy, yy] in square metres per reflector, or omit it.",
            )
        given.setflags(write=False)
        return given

    def _in_space(self) -> NDArray[np.float64]:
        """(K, 3) positions with their heights, m."""
        return np.concatenate([self.positions, np.asarray(self.heights)[:, None]], axis=1)

    @property
    def size(self) -> int:
        """Number of reflectors K."""
        return len(self.positions)

    @cached_property
    def radius_m(self) -> float:
        """Distance of the outermost reflector from the axis, m."""
        return float(np.linalg.norm(self.positions, axis=1).max())

    @property
    def sigma_m(self) -> float:
        """Largest standard deviation of a reflector's position in any direction, m; 0 if not measured."""
        return 0.0 if self.covariance is None else float(np.sqrt(np.linalg.eigvalsh(self.covariance).max()))

    def check_room(self) -> None:
        """Raises UsageError if a reflector is outside an object of this kind.

        For new layouts only: layouts enrolled under other rules must stay readable.
        """
        room = KIND_RADIUS_M[self.kind]
        if self.radius_m > room:
            raise UsageError(
                f"layout {self.name}: a reflector is {self.radius_m:g} m from the axis, outside the object: "
                f"a {self.kind} has a radius up to {room:g} m",
                f"Check the positions, or enroll it as kind other, with a radius up to {MAX_RADIUS_M:g} m.",
            )

    def placed(self, rotation_rad: float, centre_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """(K, 2) positions after a counter-clockwise rotation about the origin and a shift, m."""
        return self.positions @ rotation_matrix(rotation_rad).T + np.asarray(centre_m)

    def mirrored(self) -> Layout:
        """The mirrored layout (y negated), as seen if the direction of rotation is assumed wrongly."""
        flip = np.array([1.0, -1.0])
        seen = None if self.covariance is None else self.covariance * np.outer(flip, flip)
        return replace(self, positions=self.positions * flip, covariance=seen)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; `layout_from_dict` reads them."""
        heights = [float(h) for h in np.asarray(self.heights)]
        seen = self.covariance
        rows = [] if seen is None else [[float(c[0, 0]), float(c[0, 1]), float(c[1, 1])] for c in seen]
        return {
            "name": self.name,
            "kind": self.kind,
            "label": self.label,
            "positions_m": [[float(x), float(y)] for x, y in self.positions],
            **({"heights_m": heights} if any(heights) else {}),
            **({"covariance_m2": rows} if rows else {}),
            "symmetry": self.symmetry,
            "notes": self.notes,
        }


def layout_from_dict(data: Mapping[str, Any]) -> Layout:
    """Layout from plain JSON values; UsageError names the field that is missing, unknown or wrong."""
    if not isinstance(data, Mapping):
        raise UsageError("a layout is a table of fields", f"Give the fields {', '.join(_FIELDS)}.")
    for name in ("name", "positions_m"):
        if name not in data:
            raise UsageError(f"the layout's field {name} is missing", "Give at least name and positions_m.")
    unknown = sorted(str(key)[:40] for key in set(data) - set(_FIELDS))
    if unknown:
        raise UsageError(
            f"unknown layout field {', '.join(unknown)}", f"The fields are {', '.join(_FIELDS)}."
        )
    if not _numbers(data["positions_m"], 2):
        raise UsageError(
            "the layout's field positions_m is not a list of [x, y] pairs",
            "Give each reflector as [x, y] in metres.",
        )
    apart = ("positions_m", "heights_m", "covariance_m2")
    rest = {name: data[name] for name in _FIELDS if name in data and name not in apart}
    heights, seen = data.get("heights_m"), data.get("covariance_m2")
    if heights is not None and not _numbers([heights], None):
        raise UsageError(
            "the layout's field heights_m is not a list of numbers",
            "Give one height per reflector, in metres.",
        )
    if seen is not None and not _numbers(seen, 3):
        raise UsageError(
            "the layout's field covariance_m2 is not a list of [xx, xy, yy]",
            "Give one covariance per reflector, in square metres, or omit it.",
        )
    covariance = None if seen is None else [[[xx, xy], [xy, yy]] for xx, xy, yy in seen]
    return Layout(positions=data["positions_m"], heights=heights, covariance=covariance, **rest)  # type: ignore[arg-type]


def _numbers(rows: Any, width: int | None) -> bool:
    """Whether it is a list of lists of `width` plain numbers each; any number if None."""
    return isinstance(rows, list) and all(
        isinstance(row, list)
        and width in (None, len(row))
        and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in row)
        for row in rows
    )


def read_layout(path: Path) -> Layout:
    """Layout from a .toml or .json file.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: it is too large, not TOML/JSON, or a field is wrong; the message names both.
    """
    raw = read_bytes(path, MAX_FILE_BYTES)
    try:
        parse = parse_json if path.suffix.lower() == ".json" else parse_toml
        data = parse(raw, str(path))
    except FileFormatError as error:
        raise FileFormatError(error.message, "Give name and positions_m = [[x, y], ...] in metres.") from None
    try:
        return layout_from_dict(data)
    except TagidError as error:
        raise FileFormatError(f"{path}: {error.message}", error.remedy) from error


@cache
def _builtin() -> tuple[Layout, ...]:
    folder = resources.files("tagid.tags.layouts") / "data" / "layouts"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return tuple(layout_from_dict(parse_toml(f.read_bytes(), f.name)) for f in files)


def builtin_layouts() -> dict[str, Layout]:
    """The layouts of the package, by name: the paper's two containers and two helmets."""
    return {layout.name: layout for layout in _builtin()}
