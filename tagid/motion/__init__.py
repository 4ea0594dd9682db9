"""How the object turned: device URLs, the radar's clock, the rotation period, and an angle for every scan.

Nothing here forms an image; the period comes from the scans' own repetition.
"""

from tagid.motion.angles import Angles, average_into_views, select_views
from tagid.motion.clock import UniformClock, fit_clock
from tagid.motion.device import Motion, MotionStoppedError, Track
from tagid.motion.period import PeriodEstimate, find_period
from tagid.motion.turntable import FreeTurntable
from tagid.motion.urls import open_motion

__all__ = [
    "Angles",
    "FreeTurntable",
    "Motion",
    "MotionStoppedError",
    "PeriodEstimate",
    "Track",
    "UniformClock",
    "average_into_views",
    "find_period",
    "fit_clock",
    "open_motion",
    "select_views",
]
