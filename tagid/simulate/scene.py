"""What stands in front of the radar, sorted by how it moves: the object, the turntable's own parts, the room.

The sorting is what the imaging must cope with: only the object is placed off-centre and turned, what is
symmetric about the axis or stands in the room gives the same echo in every view.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.simulate.scattering import Body, Points


@dataclass(frozen=True, eq=False)
class StaticReturns:
    """Echoes that no turn changes: walls, the table's foot, the leakage from antenna to antenna.

    Attributes:
        ranges_m: (n,) one-way range, m.
        amplitudes: (n,) as received (spreading and beam already in it); 1 is a unit reflector at the axis.
    """

    ranges_m: NDArray[np.float64]
    amplitudes: NDArray[np.float64]

    def __post_init__(self) -> None:
        if np.ndim(self.ranges_m) != 1 or np.shape(self.ranges_m) != np.shape(self.amplitudes):
            raise DataError("static returns need as many ranges as amplitudes, in one dimension")
        if not (np.isfinite(self.ranges_m).all() and np.isfinite(self.amplitudes).all()):
            raise DataError("static returns are not finite")


@dataclass(frozen=True, eq=False)
class Scene:
    """A frozen scene.

    Attributes:
        name: for people and for the capture's object field.
        object: bodies that turn and are placed with an offset and a rotation.
        turntable: bodies that turn about the axis but are never off-centre (a shell around the axis).
        room: echoes that stand still, or None.
        reference_amplitude: peak that an SNR refers to, where it is not the strongest turning echo of the
            object itself (an untagged object, an empty table).
        description: plain JSON values that go into the capture's object field.
    """

    name: str
    object: tuple[Body, ...] = ()
    turntable: tuple[Body, ...] = ()
    room: StaticReturns | None = None
    reference_amplitude: float | None = None
    description: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of_points(
        cls,
        positions: NDArray[np.floating],
        amplitudes: NDArray[np.number] | None = None,
        name: str = "points",
    ) -> Scene:
        """Bare points at (n, 2) or (n, 3) m, amplitude 1 unless given."""
        a = np.ones(len(positions)) if amplitudes is None else amplitudes
        return cls(name, (Points(positions, a),))

    @property
    def points(self) -> Points | None:
        """The object's first set of points: a tag's reflectors, where the scene has one."""
        return next((body for body in self.object if isinstance(body, Points)), None)
