"""The scene in front of the radar: a rotating object and a static room.

Everything that belongs to the object (reflectors, body, handle, rim, seam, contents) is placed together with
it, also off the rotation axis.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.simulate.scatterers import Mounted
from tagid.simulate.scattering import Body, Points
from tagid.simulate.snr import EchoLevels


@dataclass(frozen=True, eq=False)
class StaticReturns:
    """Echoes that do not change as the object rotates: walls, the table's foot, antenna leakage.

    Attributes:
        ranges_m: (n,) one-way range, m.
        amplitudes: (n,) as received (spreading and beam included); 1 is a unit reflector on the axis.
    """

    ranges_m: NDArray[np.float64]
    amplitudes: NDArray[np.float64]

    def __post_init__(self) -> None:
        if np.ndim(self.ranges_m) != 1 or np.shape(self.ranges_m) != np.shape(self.amplitudes):
            raise DataError("static returns need as many ranges as amplitudes, in one dimension")
        if not (np.isfinite(self.ranges_m).all() and np.isfinite(self.amplitudes).all()):
            raise DataError("static returns are not finite")


Tag = Points | Mounted
"""The reflectors of an object: a body that gives access to each of them."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A frozen scene.

    Attributes:
        name: for display and for the capture's object field.
        object: bodies that rotate with the object and share its placement. The first one
            that is a `Tag` holds the reflectors.
        room: static echoes, or None.
        reference_amplitude: peak to which an SNR refers in a scene without reflectors (an untagged object, an
            empty table); None refers to the object's own peak.
        levels: peaks to which an SNR refers if they are known otherwise than from the scene's own bodies.
        description: plain JSON values that go into the capture's object field.
    """

    name: str
    object: tuple[Body, ...] = ()
    room: StaticReturns | None = field(default=None, kw_only=True)
    reference_amplitude: float | None = field(default=None, kw_only=True)
    levels: EchoLevels | None = field(default=None, kw_only=True)
    description: dict[str, Any] = field(default_factory=dict, kw_only=True)

    @classmethod
    def of_points(
        cls, positions: NDArray[np.floating], amplitudes: NDArray[np.number] | None = None
    ) -> Scene:
        """Bare points at (n, 2) or (n, 3) m, amplitude 1 unless given."""
        a = np.ones(len(positions)) if amplitudes is None else amplitudes
        return cls("points", (Points(positions, a),))

    @property
    def tag(self) -> Tag | None:
        """The object's reflectors, if the scene has any."""
        return next((body for body in self.object if isinstance(body, Tag)), None)

    @property
    def points(self) -> Points | None:
        """The object's first set of points."""
        return next((body for body in self.object if isinstance(body, Points)), None)
