"""Solved objects that had no part in making the reader: bodies, tags on them, foreign tags.

Dimensions, reflector sizes, mounting radii, places, materials and shapes differ from tests/data/responses and
from ../shared/fullwave. Objects of development may serve to find faults and to choose constants, so may those
that were sealed and reported once (`OPENED`); sealed ones are only reported.

    PYTHONPATH=. OMP_NUM_THREADS=1 python tests/benchmarks/unseen_objects.py --out build/unseen

solves those whose files are missing; a new set takes about half an hour of one core.
"""

from __future__ import annotations

import numpy as np
from solve_responses import Object, main

from tagid.simulate.response import Ring
from train.fullwave import Mesh, Sweep, shapes

SWEEP = Sweep(
    frequencies=21,
    rings=(
        *(Ring(d, "V", h) for h in (0.0, 0.1) for d in (0.8, 1.2)),
        *(Ring(d, "H") for d in (0.8, 1.2)),
    ),
)
"""Upright polarisation from two heights: the tag may stand lower than the antenna."""

LAYOUTS = {"c90": "container-90", "c180": "container-180", "h120": "helmet-120", "lin": "helmet-linear"}
"""Ending of an object's name: the built-in layout that it carries. Any other ending carries none."""


def ring(radius_mm: float, *degrees: float) -> tuple[tuple[float, float], ...]:
    """Places on a ring."""
    return tuple((radius_mm, angle) for angle in degrees)


def _profile(edge_m: float, *points_mm: tuple[float, float]) -> Mesh:
    """A metal surface of revolution through points (radius, z)."""
    return shapes.revolved(1e-3 * np.array(points_mm), edge_m)


def _closed25() -> Mesh:
    return _profile(0.009, (0, -40), (25, -40), (25, 40), (0, 40))


def _wide45() -> Mesh:
    """A wide can, open, with a rim of 4 mm."""
    return _profile(0.010, (0, -50), (45, -50), (45, 50), (49, 50))


def _rim45() -> Mesh:
    """The same with an upright seam that stands off its wall."""
    return Mesh.join(_wide45(), shapes.plate(0.005, 0.090, 0.010).moved((0.0, 0.0495, 0.0)))


def _plastic40() -> Mesh:
    return shapes.can(0.040, 0.100, 0.0095, shapes.sheet(2.3, 0.003))


def _shell76() -> Mesh:
    return shapes.helmet((0.076, 0.098, 0.070), 0.020, 0.0100, shapes.sheet(3.0, 0.0025))


def _box55() -> Mesh:
    return shapes.box((0.055, 0.055, 0.100), 0.010)


def _mug38() -> Mesh:
    """Ceramic, with a ceramic handle."""
    wall = shapes.sheet(4.5, 0.0025)
    handle = shapes.handle(0.040, 0.026, 0.055, 0.012, 0.009, wall).moved(turn_rad=np.deg2rad(225))
    return Mesh.join(shapes.can(0.038, 0.080, 0.009, wall), handle)


def _closed32() -> Mesh:
    return _profile(0.009, (0, -50), (32, -50), (32, 50), (0, 50))


def _oval() -> Mesh:
    """A metal bottle of 58 by 76 mm with a neck."""
    profile = 1e-3 * np.array([(0, -55), (33.5, -55), (33.5, 35), (16, 55), (16, 70)])
    return shapes.revolved(profile, 0.0095, (29 / 33.5, 38 / 33.5))


def _cup33() -> Mesh:
    return shapes.can(0.033, 0.095, 0.009, shapes.sheet(6.0, 0.002))


def _shell70() -> Mesh:
    return shapes.helmet((0.070, 0.088, 0.085), 0.015, 0.0105, shapes.sheet(2.6, 0.004))


def _mug31() -> Mesh:
    """Metal, with a tall handle."""
    handle = shapes.handle(0.033, 0.024, 0.070, 0.010, 0.009).moved(turn_rad=np.deg2rad(120))
    return Mesh.join(shapes.can(0.031, 0.095, 0.009), handle)


def _tin28() -> Mesh:
    return _profile(0.009, (0, -35), (28, -35), (28, 35), (0, 35))


def _bottle() -> Mesh:
    """Metal, with a shoulder and a neck."""
    return _profile(0.009, (0, -60), (30, -60), (30, 20), (13, 45), (13, 65))


def _glass35() -> Mesh:
    return shapes.can(0.035, 0.110, 0.0092, shapes.sheet(5.5, 0.0035))


def _pail() -> Mesh:
    """A metal pail, wider at the top, open."""
    return _profile(0.0095, (0, -45), (31, -45), (39, 45))


def _jug36() -> Mesh:
    """Ceramic, with a wide ceramic handle."""
    wall = shapes.sheet(5.2, 0.003)
    handle = shapes.handle(0.038, 0.032, 0.065, 0.014, 0.009, wall).moved(turn_rad=np.deg2rad(165))
    return Mesh.join(shapes.can(0.036, 0.095, 0.009, wall), handle)


def _mug35() -> Mesh:
    """Metal, with a low flat handle."""
    handle = shapes.handle(0.037, 0.022, 0.042, 0.014, 0.009).moved(turn_rad=np.deg2rad(305))
    return Mesh.join(shapes.can(0.035, 0.085, 0.009), handle)


def _shell73() -> Mesh:
    return shapes.helmet((0.073, 0.094, 0.078), 0.020, 0.0102, shapes.sheet(3.2, 0.003))


def _tumbler() -> Mesh:
    """A drinking glass, wider at the top."""
    profile = 1e-3 * np.array([(0, -52), (29, -52), (37, 52)])
    return shapes.revolved(profile, 0.0090, sheet_m=shapes.sheet(6.6, 0.0030))


def _jar42() -> Mesh:
    return shapes.can(0.042, 0.090, 0.0095, shapes.sheet(5.8, 0.0040))


def _beaker31() -> Mesh:
    return shapes.can(0.031, 0.120, 0.0092, shapes.sheet(2.3, 0.0020))


def _tin37() -> Mesh:
    return _profile(0.0095, (0, -45), (37, -45), (37, 45), (0, 45))


def _soda34() -> Mesh:
    """A drink can, closed, with a shoulder."""
    return _profile(0.0095, (0, -58), (34, -58), (34, 46), (26, 58), (0, 58))


def _crock38() -> Mesh:
    return shapes.can(0.038, 0.084, 0.0093, shapes.sheet(6.4, 0.0030))


def _flask29() -> Mesh:
    return shapes.can(0.029, 0.100, 0.0090, shapes.sheet(4.7, 0.0022))


def _goblet33() -> Mesh:
    """A metal cup, wider at the top, open."""
    return _profile(0.0093, (0, -44), (30, -44), (35, 44))


def _tub41() -> Mesh:
    return shapes.can(0.041, 0.080, 0.0098, shapes.sheet(2.6, 0.0035))


def _mug33() -> Mesh:
    """Metal, with a wide handle that stands near its upper rim."""
    handle = shapes.handle(0.035, 0.028, 0.056, 0.012, 0.009).moved((0.0, 0.0, 0.008), np.deg2rad(80))
    return Mesh.join(shapes.can(0.033, 0.090, 0.009), handle)


def _box60() -> Mesh:
    return shapes.box((0.060, 0.048, 0.095), 0.010)


def _box66() -> Mesh:
    return shapes.box((0.066, 0.050, 0.088), 0.010)


def _crate58() -> Mesh:
    """Plastic, open at the top."""
    return shapes.box((0.058, 0.058, 0.090), 0.0098, shapes.sheet(2.6, 0.004))


def _mug37() -> Mesh:
    """Metal, with a thin handle at half its height."""
    handle = shapes.handle(0.039, 0.024, 0.050, 0.009, 0.009).moved((0.0, 0.0, -0.004), np.deg2rad(235))
    return Mesh.join(shapes.can(0.037, 0.084, 0.0093), handle)


def _can31() -> Mesh:
    return shapes.can(0.031, 0.092, 0.0090)


def _cup39() -> Mesh:
    return shapes.can(0.039, 0.088, 0.0094, shapes.sheet(5.5, 0.0025))


def _mug34() -> Mesh:
    """Metal, with a handle near its lower rim."""
    handle = shapes.handle(0.036, 0.025, 0.054, 0.011, 0.009).moved((0.0, 0.0, -0.010), np.deg2rad(30))
    return Mesh.join(shapes.can(0.034, 0.094, 0.0092), handle)


def _mug40() -> Mesh:
    """Porcelain, with a porcelain handle."""
    wall = shapes.sheet(5.8, 0.0028)
    handle = shapes.handle(0.042, 0.027, 0.060, 0.013, 0.009, wall).moved(turn_rad=np.deg2rad(140))
    return Mesh.join(shapes.can(0.040, 0.084, 0.0093, wall), handle)


def _shell79() -> Mesh:
    return shapes.helmet((0.079, 0.100, 0.074), 0.018, 0.0104, shapes.sheet(2.8, 0.0030))


def _mug36() -> Mesh:
    """Metal, tall, with a square handle."""
    handle = shapes.handle(0.038, 0.026, 0.064, 0.013, 0.009).moved((0.0, 0.0, 0.004), np.deg2rad(190))
    return Mesh.join(shapes.can(0.036, 0.102, 0.0093), handle)


def _mug42() -> Mesh:
    """Stoneware, low, with a stoneware handle."""
    wall = shapes.sheet(6.2, 0.0032)
    handle = shapes.handle(0.044, 0.024, 0.050, 0.014, 0.009, wall).moved(turn_rad=np.deg2rad(65))
    return Mesh.join(shapes.can(0.042, 0.078, 0.0094, wall), handle)


def _mug30() -> Mesh:
    """Metal, slender, with a handle as wide as the mug."""
    handle = shapes.handle(0.032, 0.032, 0.058, 0.010, 0.009).moved((0.0, 0.0, -0.006), np.deg2rad(330))
    return Mesh.join(shapes.can(0.030, 0.090, 0.009), handle)


def _shell74() -> Mesh:
    return shapes.helmet((0.074, 0.096, 0.082), 0.016, 0.0103, shapes.sheet(2.5, 0.0035))


def _shell82() -> Mesh:
    return shapes.helmet((0.082, 0.099, 0.071), 0.022, 0.0104, shapes.sheet(3.1, 0.0024))


def _can36() -> Mesh:
    return _profile(0.0094, (0, -46), (36, -46), (36, 46))


def _glass38() -> Mesh:
    return shapes.can(0.038, 0.098, 0.0094, shapes.sheet(6.9, 0.0027))


def _shell77() -> Mesh:
    return shapes.helmet((0.077, 0.095, 0.086), 0.018, 0.0104, shapes.sheet(2.7, 0.0028))


def _shell81() -> Mesh:
    return shapes.helmet((0.081, 0.103, 0.078), 0.020, 0.0101, shapes.sheet(3.0, 0.0033))


def _mug39() -> Mesh:
    """Porcelain, with a slender porcelain handle."""
    wall = shapes.sheet(5.4, 0.0026)
    handle = shapes.handle(0.041, 0.025, 0.055, 0.010, 0.009, wall).moved(turn_rad=np.deg2rad(285))
    return Mesh.join(shapes.can(0.039, 0.088, 0.0093, wall), handle)


def _mug32() -> Mesh:
    """Metal, with a handle at half its height."""
    handle = shapes.handle(0.034, 0.026, 0.050, 0.012, 0.009).moved((0.0, 0.0, 0.002), np.deg2rad(110))
    return Mesh.join(shapes.can(0.032, 0.096, 0.009), handle)


def _crate62() -> Mesh:
    """Plastic, open at the top."""
    return shapes.box((0.062, 0.062, 0.085), 0.0100, shapes.sheet(2.4, 0.003))


def _carton120() -> Mesh:
    """Corrugated board, open at the top."""
    return shapes.box((0.120, 0.120, 0.110), 0.0105, shapes.sheet(1.7, 0.004))


def _carton140() -> Mesh:
    """Corrugated board, oblong, open at the top."""
    return shapes.box((0.140, 0.105, 0.120), 0.0105, shapes.sheet(1.5, 0.005))


def _carton108() -> Mesh:
    """Corrugated board, open at the top."""
    return shapes.box((0.108, 0.108, 0.130), 0.0105, shapes.sheet(1.6, 0.005))


def _carton150() -> Mesh:
    """Corrugated board, oblong, open at the top."""
    return shapes.box((0.150, 0.118, 0.100), 0.0105, shapes.sheet(1.8, 0.004))


def _crate66() -> Mesh:
    """Plastic, oblong, open at the top."""
    return shapes.box((0.066, 0.054, 0.092), 0.0098, shapes.sheet(2.3, 0.0035))


def _can33() -> Mesh:
    """A tall can, open, with a rim of 3 mm."""
    return _profile(0.0093, (0, -54), (33, -54), (33, 54), (36, 54))


def _tin41() -> Mesh:
    """Low and closed."""
    return _profile(0.0096, (0, -34), (41, -34), (41, 34), (0, 34))


def _cup34() -> Mesh:
    """Porcelain."""
    return shapes.can(0.034, 0.086, 0.0090, shapes.sheet(5.7, 0.0033))


def _glass31() -> Mesh:
    return shapes.can(0.031, 0.120, 0.0092, shapes.sheet(6.3, 0.0024))


def _mug43() -> Mesh:
    """Metal, wide, with a slender handle."""
    handle = shapes.handle(0.045, 0.026, 0.060, 0.010, 0.009).moved((0.0, 0.0, 0.003), np.deg2rad(20))
    return Mesh.join(shapes.can(0.043, 0.086, 0.0096), handle)


def _mug29() -> Mesh:
    """Enamelled metal, small, with a handle near its upper rim."""
    handle = shapes.handle(0.031, 0.022, 0.048, 0.010, 0.009).moved((0.0, 0.0, 0.010), np.deg2rad(260))
    return Mesh.join(shapes.can(0.029, 0.082, 0.009), handle)


def _mug44() -> Mesh:
    """Stoneware, with a wide stoneware handle."""
    wall = shapes.sheet(6.0, 0.0030)
    handle = shapes.handle(0.042, 0.028, 0.058, 0.014, 0.009, wall).moved(turn_rad=np.deg2rad(310))
    return Mesh.join(shapes.can(0.040, 0.092, 0.0094, wall), handle)


def _shell75() -> Mesh:
    return shapes.helmet((0.075, 0.100, 0.080), 0.017, 0.0104, shapes.sheet(2.9, 0.0026))


def _shell84() -> Mesh:
    return shapes.helmet((0.084, 0.102, 0.074), 0.019, 0.0099, shapes.sheet(2.6, 0.0032))


def _can40() -> Mesh:
    """Metal, open at the top."""
    return shapes.can(0.040, 0.094, 0.0095)


def _tin30() -> Mesh:
    """Tall and closed."""
    return _profile(0.0092, (0, -55), (30, -55), (30, 55), (0, 55))


def _bottle32() -> Mesh:
    """A plastic bottle with a shoulder and a neck."""
    profile = 1e-3 * np.array([(0, -56), (32, -56), (32, 22), (13, 46), (13, 60)])
    return shapes.revolved(profile, 0.0090, sheet_m=shapes.sheet(2.5, 0.0015))


def _mug41() -> Mesh:
    """Porcelain, with a large porcelain handle."""
    wall = shapes.sheet(5.6, 0.0030)
    handle = shapes.handle(0.043, 0.030, 0.062, 0.012, 0.009, wall).moved((0.0, 0.0, 0.005), np.deg2rad(200))
    return Mesh.join(shapes.can(0.041, 0.090, 0.0095, wall), handle)


def _mug46() -> Mesh:
    """Metal, with a handle near its upper rim."""
    handle = shapes.handle(0.037, 0.027, 0.052, 0.012, 0.009).moved((0.0, 0.0, 0.012), np.deg2rad(75))
    return Mesh.join(shapes.can(0.035, 0.098, 0.0093), handle)


def _cup37() -> Mesh:
    """Stoneware."""
    return shapes.can(0.037, 0.082, 0.0093, shapes.sheet(6.1, 0.0034))


def _shell78() -> Mesh:
    return shapes.helmet((0.078, 0.097, 0.083), 0.021, 0.0102, shapes.sheet(2.8, 0.0029))


def _shell80() -> Mesh:
    return shapes.helmet((0.080, 0.104, 0.076), 0.017, 0.0099, shapes.sheet(2.7, 0.0036))


def _can38() -> Mesh:
    """Metal, open, slightly wider at the bottom."""
    return _profile(0.0095, (0, -48), (38, -48), (36, 48))


def _jar35() -> Mesh:
    """A plastic jar, closed below."""
    profile = 1e-3 * np.array([(0, -46), (35, -46), (35, 46)])
    return shapes.revolved(profile, 0.0093, sheet_m=shapes.sheet(2.4, 0.0020))


def _bottle30() -> Mesh:
    """A plastic bottle with a long neck."""
    profile = 1e-3 * np.array([(0, -54), (30, -54), (30, 14), (12, 40), (12, 62)])
    return shapes.revolved(profile, 0.0090, sheet_m=shapes.sheet(2.7, 0.0018))


def _flask33() -> Mesh:
    """Thin plastic, with shoulders that slope."""
    profile = 1e-3 * np.array([(0, -50), (33, -50), (33, 10), (24, 34), (15, 52)])
    return shapes.revolved(profile, 0.0092, sheet_m=shapes.sheet(2.3, 0.0013))


def _pot28() -> Mesh:
    """Plastic, open at the top, a little wider there."""
    profile = 1e-3 * np.array([(0, -48), (26, -48), (29, 48)])
    return shapes.revolved(profile, 0.0090, sheet_m=shapes.sheet(2.5, 0.0023))


def _mug45() -> Mesh:
    """Plastic, with a plastic handle."""
    wall = shapes.sheet(2.6, 0.0030)
    handle = shapes.handle(0.040, 0.028, 0.056, 0.012, 0.009, wall).moved(turn_rad=np.deg2rad(150))
    return Mesh.join(shapes.can(0.038, 0.088, 0.0094, wall), handle)


def _shell83() -> Mesh:
    return shapes.helmet((0.083, 0.101, 0.080), 0.018, 0.0098, shapes.sheet(2.9, 0.0031))


DEVELOPMENT = {
    "free24_c180": Object(None, 24, ring(45, 10, 190)),
    "free24_one": Object(None, 24, ((0, 0),)),
    "closed25": Object(_closed25),
    "closed25_c90": Object(_closed25, 20, ring(41, 20, 110)),
    "closed25_c180": Object(_closed25, 30, ring(47, 30, 210)),
    "closed25_pair65": Object(_closed25, 30, ring(47, 0, 65)),
    "rim45": Object(_rim45),
    "rim45_c90": Object(_rim45, 20, ring(57, 150, 240)),
    "rim45_three": Object(_rim45, 20, ring(57, 150, 240, 20)),
    "wide45": Object(_wide45),
    "wide45_c180": Object(_wide45, 30, ring(62, 15, 195)),
    "wide45_c90": Object(_wide45, 20, ring(57, 150, 240)),
    "plastic40": Object(_plastic40),
    "plastic40_c180": Object(_plastic40, 20, ring(51, 40, 220)),
    "plastic40_pair140": Object(_plastic40, 30, ring(57, 40, 180)),
    "mug38": Object(_mug38),
    "mug38_c90": Object(_mug38, 30, ring(55, 0, 90)),
    "box55": Object(_box55),
    "box55_c180": Object(_box55, 20, ring(45, 0, 180)),
    "box55_pair120": Object(_box55, 20, ring(45, 0, 120)),
    "shell76": Object(_shell76),
    "shell76_h120": Object(_shell76, 30, ring(114, 15, 135, 255)),
    "shell76_lin": Object(_shell76, 20, ((90, 0), (90, 180), (0, 0))),
}
"""Objects on which faults may be found and constants chosen."""

OPENED = {
    "closed32": Object(_closed32),
    "closed32_c180": Object(_closed32, 20, ring(44, 25, 205)),
    "closed32_c90": Object(_closed32, 30, ring(51, 65, 155)),
    "closed32_pair140": Object(_closed32, 30, ring(51, 0, 140)),
    "cup33": Object(_cup33),
    "cup33_c90": Object(_cup33, 20, ring(45, 10, 100)),
    "cup33_four": Object(_cup33, 20, ring(45, 0, 90, 160, 260)),
    "oval": Object(_oval),
    "oval_c90": Object(_oval, 20, ring(52, 45, 135)),
    "mug31": Object(_mug31),
    "mug31_c180": Object(_mug31, 30, ring(49, 30, 210)),
    "mug31_pair60": Object(_mug31, 20, ring(45, 0, 60)),
    "shell70": Object(_shell70),
    "shell70_h120": Object(_shell70, 40, ring(112, 70, 190, 310)),
    "shell70_lin": Object(_shell70, 20, ((90, 0), (90, 180), (0, 0))),
    "free18_c90": Object(None, 18, ring(45, 200, 290)),
    "free36_three": Object(None, 36, ring(45, 0, 75, 200)),
    "tin28": Object(_tin28),
    "tin28_c90": Object(_tin28, 20, ring(45, 95, 185)),
    "tin28_c180": Object(_tin28, 30, ring(49, 50, 230)),
    "tin28_pair105": Object(_tin28, 30, ring(49, 0, 105)),
    "bottle": Object(_bottle),
    "bottle_c180": Object(_bottle, 20, ring(47, 5, 185)),
    "bottle_three": Object(_bottle, 20, ring(47, 5, 185, 260)),
    "glass35": Object(_glass35),
    "glass35_c180": Object(_glass35, 30, ring(54, 35, 215)),
    "glass35_c90": Object(_glass35, 20, ring(47, 35, 125)),
    "pail": Object(_pail),
    "pail_c90": Object(_pail, 20, ring(48, 60, 150)),
    "pail_pair150": Object(_pail, 30, ring(53, 0, 150)),
    "jug36": Object(_jug36),
    "jug36_c90": Object(_jug36, 30, ring(53, 20, 110)),
    "mug35": Object(_mug35),
    "mug35_c180": Object(_mug35, 20, ring(46, 60, 240)),
    "mug35_three": Object(_mug35, 20, ring(46, 60, 240, 120)),
    "shell73": Object(_shell73),
    "shell73_h120": Object(_shell73, 30, ring(111, 40, 160, 280)),
    "shell73_lin": Object(_shell73, 30, ((90, 0), (90, 180), (0, 0))),
    "mug33": Object(_mug33),
    "mug33_c180": Object(_mug33, 24, ring(47, 15, 195)),
    "mug33_quad": Object(_mug33, 24, ring(47, 353, 37, 173, 217)),
    "box60": Object(_box60),
    "box60_c180": Object(_box60, 24, ring(43, 0, 180)),
    "box60_quad": Object(_box60, 24, ring(43, 340, 20, 160, 200)),
    "tumbler": Object(_tumbler),
    "tumbler_c180": Object(_tumbler, 20, ring(46, 75, 255)),
    "tumbler_c90": Object(_tumbler, 30, ring(52, 160, 250)),
    "tumbler_pair110": Object(_tumbler, 20, ring(48, 0, 110)),
    "jar42": Object(_jar42),
    "jar42_c180": Object(_jar42, 24, ring(56, 20, 200)),
    "jar42_c90": Object(_jar42, 20, ring(52, 130, 220)),
    "jar42_three": Object(_jar42, 20, ring(52, 0, 95, 190)),
    "beaker31": Object(_beaker31),
    "beaker31_c180": Object(_beaker31, 20, ring(43, 110, 290)),
    "beaker31_c90": Object(_beaker31, 30, ring(48, 5, 95)),
    "beaker31_pair70": Object(_beaker31, 30, ring(48, 0, 70)),
    "tin37": Object(_tin37),
    "tin37_c180": Object(_tin37, 20, ring(49, 65, 245)),
    "tin37_c90": Object(_tin37, 18, ring(47, 10, 100)),
    "tin37_three": Object(_tin37, 20, ring(49, 65, 245, 175)),
    "soda34": Object(_soda34),
    "soda34_c180": Object(_soda34, 20, ring(46, 125, 305)),
    "soda34_c90": Object(_soda34, 24, ring(49, 30, 120)),
    "soda34_pair125": Object(_soda34, 24, ring(48, 0, 125)),
    "crock38": Object(_crock38),
    "crock38_c180": Object(_crock38, 20, ring(50, 80, 260)),
    "crock38_c90": Object(_crock38, 24, ring(51, 200, 290)),
    "crock38_four": Object(_crock38, 20, ring(50, 0, 70, 150, 250)),
    "flask29": Object(_flask29),
    "flask29_c180": Object(_flask29, 24, ring(44, 55, 235)),
    "flask29_c90": Object(_flask29, 20, ring(43, 0, 90)),
    "flask29_three": Object(_flask29, 20, ring(43, 0, 120, 210)),
    "goblet33": Object(_goblet33),
    "goblet33_c180": Object(_goblet33, 30, ring(50, 10, 190)),
    "goblet33_c90": Object(_goblet33, 20, ring(47, 145, 235)),
    "goblet33_pair60": Object(_goblet33, 20, ring(47, 0, 60)),
    "tub41": Object(_tub41),
    "tub41_c180": Object(_tub41, 24, ring(51, 100, 280)),
    "tub41_c90": Object(_tub41, 20, ring(50, 45, 135)),
    "tub41_pair150": Object(_tub41, 20, ring(50, 0, 150)),
    "box66": Object(_box66),
    "box66_c180": Object(_box66, 24, ring(47, 0, 180)),
    "box66_quad": Object(_box66, 20, ring(46, 342, 18, 162, 198)),
    "crate58": Object(_crate58),
    "crate58_c90": Object(_crate58, 20, ring(44, 0, 90)),
    "crate58_quad": Object(_crate58, 20, ring(45, 341, 19, 161, 199)),
    "carton120": Object(_carton120),
    "carton120_c90": Object(_carton120, 24, ring(45, 20, 110)),
    "carton120_c180": Object(_carton120, 20, ring(45, 50, 230)),
    "carton120_pair70": Object(_carton120, 24, ring(45, 20, 90)),
    "carton140": Object(_carton140),
    "carton140_c90": Object(_carton140, 20, ring(45, 100, 190)),
    "carton140_three": Object(_carton140, 24, ring(45, 0, 100, 220)),
    "mug37": Object(_mug37),
    "mug37_c180": Object(_mug37, 20, ring(48, 300, 120)),
    "mug37_quad": Object(_mug37, 20, ring(48, 278, 322, 98, 142)),
    "free22_c180": Object(None, 22, ring(45, 70, 250)),
    "free32_h120": Object(None, 32, ring(111, 5, 125, 245)),
    "free26_three": Object(None, 26, ring(45, 0, 90, 200)),
    "can31": Object(_can31),
    "can31_c90": Object(_can31, 24, ring(46, 130, 220)),
    "can31_c180": Object(_can31, 30, ring(48, 65, 245)),
    "can31_pair55": Object(_can31, 20, ring(46, 0, 55)),
    "cup39": Object(_cup39),
    "cup39_c180": Object(_cup39, 20, ring(51, 15, 195)),
    "cup39_c90": Object(_cup39, 24, ring(50, 95, 185)),
    "cup39_three": Object(_cup39, 20, ring(51, 0, 80, 180)),
    "mug34": Object(_mug34),
    "mug34_c90": Object(_mug34, 24, ring(47, 100, 190)),
    "mug34_c180": Object(_mug34, 36, ring(52, 85, 265)),
    "mug34_three": Object(_mug34, 24, ring(47, 100, 190, 300)),
    "mug40": Object(_mug40),
    "mug40_c180": Object(_mug40, 24, ring(53, 50, 230)),
    "mug40_c90": Object(_mug40, 20, ring(51, 190, 280)),
    "mug40_pair120": Object(_mug40, 24, ring(53, 0, 120)),
    "shell79": Object(_shell79),
    "shell79_h120": Object(_shell79, 24, ring(115, 60, 180, 300)),
    "shell79_lin": Object(_shell79, 36, ((90, 90), (90, 270), (0, 0))),
    "shell79_three": Object(_shell79, 24, ring(115, 60, 160, 300)),
    "mug36": Object(_mug36),
    "mug36_c90": Object(_mug36, 24, ring(49, 220, 310)),
    "mug36_c180": Object(_mug36, 20, ring(48, 95, 275)),
    "mug36_pair130": Object(_mug36, 24, ring(49, 30, 160)),
    "mug42": Object(_mug42),
    "mug42_c90": Object(_mug42, 20, ring(53, 120, 210)),
    "mug42_c180": Object(_mug42, 30, ring(58, 20, 200)),
    "mug42_three": Object(_mug42, 24, ring(55, 0, 90, 230)),
    "mug30": Object(_mug30),
    "mug30_c90": Object(_mug30, 20, ring(43, 10, 100)),
    "mug30_c180": Object(_mug30, 24, ring(45, 70, 250)),
    "mug30_one": Object(_mug30, 24, ring(45, 70)),
    "shell74": Object(_shell74),
    "shell74_h120": Object(_shell74, 24, ring(112, 25, 145, 265)),
    "shell74_lin": Object(_shell74, 24, ((90, 0), (90, 180), (0, 0))),
    "shell74_pair150": Object(_shell74, 30, ring(112, 0, 150)),
    "shell82": Object(_shell82),
    "shell82_h120": Object(_shell82, 30, ring(116, 80, 200, 320)),
    "shell82_lin": Object(_shell82, 30, ((90, 90), (90, 270), (0, 0))),
    "shell82_four": Object(_shell82, 24, ring(113, 0, 100, 180, 260)),
    "can36": Object(_can36),
    "can36_c90": Object(_can36, 20, ring(48, 170, 260)),
    "can36_c180": Object(_can36, 30, ring(52, 40, 220)),
    "can36_pair75": Object(_can36, 24, ring(50, 0, 75)),
    "glass38": Object(_glass38),
    "glass38_c90": Object(_glass38, 24, ring(50, 60, 150)),
    "glass38_c180": Object(_glass38, 20, ring(49, 115, 295)),
    "glass38_three": Object(_glass38, 20, ring(49, 0, 100, 220)),
    "shell77": Object(_shell77),
    "shell77_h120": Object(_shell77, 24, ring(113, 35, 155, 275)),
    "shell77_lin": Object(_shell77, 30, ((90, 0), (90, 180), (0, 0))),
    "shell77_pair100": Object(_shell77, 24, ring(113, 35, 135)),
    "shell81": Object(_shell81),
    "shell81_h120": Object(_shell81, 28, ring(116, 10, 130, 250)),
    "shell81_lin": Object(_shell81, 24, ((90, 90), (90, 270), (0, 0))),
    "shell81_three": Object(_shell81, 28, ring(115, 0, 95, 220)),
    "mug39": Object(_mug39),
    "mug39_c90": Object(_mug39, 24, ring(52, 20, 110)),
    "mug39_c180": Object(_mug39, 20, ring(51, 60, 240)),
    "mug39_pair60": Object(_mug39, 24, ring(52, 20, 80)),
    "mug32": Object(_mug32),
    "mug32_c90": Object(_mug32, 20, ring(45, 220, 310)),
    "mug32_c180": Object(_mug32, 24, ring(46, 20, 200)),
    "mug32_three": Object(_mug32, 20, ring(45, 220, 310, 35)),
    "crate62": Object(_crate62),
    "crate62_c90": Object(_crate62, 24, ring(46, 0, 90)),
    "crate62_c180": Object(_crate62, 20, ring(46, 90, 270)),
    "crate62_three": Object(_crate62, 20, ring(46, 0, 90, 180)),
    "carton108": Object(_carton108),
    "carton108_c180": Object(_carton108, 24, ring(45, 75, 255)),
    "carton108_c90": Object(_carton108, 30, ring(45, 5, 95)),
    "carton108_pair65": Object(_carton108, 30, ring(45, 5, 70)),
    "carton150": Object(_carton150),
    "carton150_c90": Object(_carton150, 20, ring(46, 200, 290)),
    "carton150_c180": Object(_carton150, 30, ring(44, 30, 210)),
    "carton150_four": Object(_carton150, 24, ring(45, 0, 75, 160, 255)),
    "can33": Object(_can33),
    "can33_c90": Object(_can33, 24, ring(47, 75, 165)),
    "can33_c180": Object(_can33, 20, ring(46, 140, 320)),
    "can33_three": Object(_can33, 20, ring(47, 0, 110, 240)),
    "tin41": Object(_tin41),
    "tin41_c180": Object(_tin41, 24, ring(54, 5, 185)),
    "tin41_c90": Object(_tin41, 30, ring(55, 215, 305)),
    "tin41_pair120": Object(_tin41, 24, ring(54, 0, 120)),
    "cup34": Object(_cup34),
    "cup34_c90": Object(_cup34, 22, ring(47, 30, 120)),
    "cup34_c180": Object(_cup34, 20, ring(45, 85, 265)),
    "cup34_four": Object(_cup34, 20, ring(46, 0, 90, 180, 270)),
    "glass31": Object(_glass31),
    "glass31_c180": Object(_glass31, 20, ring(44, 25, 205)),
    "glass31_c90": Object(_glass31, 26, ring(46, 150, 240)),
    "glass31_pair60": Object(_glass31, 24, ring(45, 0, 60)),
    "mug43": Object(_mug43),
    "mug43_c90": Object(_mug43, 24, ring(56, 110, 200)),
    "mug43_c180": Object(_mug43, 30, ring(57, 75, 255)),
    "mug43_one": Object(_mug43, 30, ring(56, 110)),
    "mug29": Object(_mug29),
    "mug29_c180": Object(_mug29, 20, ring(43, 20, 200)),
    "mug29_c90": Object(_mug29, 24, ring(44, 40, 130)),
    "mug29_three": Object(_mug29, 20, ring(43, 20, 200, 110)),
    "mug44": Object(_mug44),
    "mug44_c90": Object(_mug44, 20, ring(52, 100, 190)),
    "mug44_c180": Object(_mug44, 26, ring(54, 35, 215)),
    "mug44_pair130": Object(_mug44, 24, ring(53, 60, 190)),
    "shell75": Object(_shell75),
    "shell75_h120": Object(_shell75, 22, ring(112, 50, 170, 290)),
    "shell75_lin": Object(_shell75, 26, ((90, 90), (90, 270), (0, 0))),
    "shell75_pair90": Object(_shell75, 24, ring(111, 50, 140)),
    "shell84": Object(_shell84),
    "shell84_h120": Object(_shell84, 30, ring(114, 5, 125, 245)),
    "shell84_lin": Object(_shell84, 24, ((90, 0), (90, 180), (0, 0))),
    "shell84_three": Object(_shell84, 24, ring(113, 0, 80, 200)),
    "can40": Object(_can40),
    "can40_c90": Object(_can40, 40, ring(62, 140, 230)),
    "can40_c180": Object(_can40, 20, ring(51, 35, 215)),
    "can40_three": Object(_can40, 20, ring(51, 0, 85, 210)),
    "tin30": Object(_tin30),
    "tin30_c90": Object(_tin30, 20, ring(43, 70, 160)),
    "tin30_c180": Object(_tin30, 36, ring(49, 120, 300)),
    "tin30_pair65": Object(_tin30, 24, ring(45, 70, 135)),
    "bottle32": Object(_bottle32),
    "bottle32_c90": Object(_bottle32, 20, ring(44, 185, 275)),
    "bottle32_c180": Object(_bottle32, 28, ring(47, 15, 195)),
    "bottle32_pair115": Object(_bottle32, 24, ring(45, 0, 115)),
    "cup37": Object(_cup37),
    "cup37_c90": Object(_cup37, 24, ring(50, 55, 145)),
    "cup37_c180": Object(_cup37, 20, ring(48, 165, 345)),
    "cup37_three": Object(_cup37, 20, ring(48, 0, 90, 195)),
    "mug41": Object(_mug41),
    "mug41_c90": Object(_mug41, 22, ring(52, 50, 140)),
    "mug41_c180": Object(_mug41, 28, ring(55, 110, 290)),
    "mug41_pair60": Object(_mug41, 24, ring(53, 0, 60)),
    "mug46": Object(_mug46),
    "mug46_c90": Object(_mug46, 20, ring(46, 140, 230)),
    "mug46_c180": Object(_mug46, 28, ring(49, 160, 340)),
    "mug46_three": Object(_mug46, 20, ring(46, 140, 230, 0)),
    "shell78": Object(_shell78),
    "shell78_h120": Object(_shell78, 20, ring(110, 20, 140, 260)),
    "shell78_lin": Object(_shell78, 30, ((90, 0), (90, 180), (0, 0))),
    "shell78_pair120": Object(_shell78, 24, ring(111, 20, 140)),
    "shell80": Object(_shell80),
    "shell80_h120": Object(_shell80, 40, ring(114, 75, 195, 315)),
    "shell80_lin": Object(_shell80, 20, ((90, 90), (90, 270), (0, 0))),
    "shell80_three": Object(_shell80, 26, ring(112, 0, 90, 215)),
    "can38": Object(_can38),
    "can38_c90": Object(_can38, 20, ring(48, 15, 105)),
    "can38_c180": Object(_can38, 34, ring(56, 75, 255)),
    "can38_three": Object(_can38, 20, ring(48, 0, 120, 215)),
    "jar35": Object(_jar35),
    "jar35_c90": Object(_jar35, 24, ring(46, 130, 220)),
    "jar35_c180": Object(_jar35, 20, ring(45, 60, 240)),
    "jar35_pair120": Object(_jar35, 24, ring(46, 0, 120)),
    "bottle30": Object(_bottle30),
    "bottle30_c90": Object(_bottle30, 22, ring(45, 205, 295)),
    "bottle30_c180": Object(_bottle30, 26, ring(45, 100, 280)),
    "bottle30_three": Object(_bottle30, 22, ring(45, 0, 85, 200)),
    "mug45": Object(_mug45),
    "mug45_c90": Object(_mug45, 24, ring(51, 20, 110)),
    "mug45_c180": Object(_mug45, 20, ring(50, 80, 260)),
    "mug45_pair65": Object(_mug45, 24, ring(51, 0, 65)),
    "shell83": Object(_shell83),
    "shell83_h120": Object(_shell83, 24, ring(113, 40, 160, 280)),
    "shell83_lin": Object(_shell83, 28, ((90, 0), (90, 180), (0, 0))),
    "shell83_four": Object(_shell83, 24, ring(112, 0, 80, 190, 260)),
    "bottle30_pair150": Object(_bottle30, 26, ring(45, 100, 250)),
    "bottle30_pair155": Object(_bottle30, 22, ring(45, 30, 185)),
    "jar35_pair150": Object(_jar35, 24, ring(45, 60, 210)),
}
"""Objects that were sealed, reported, and looked at since, and three pairs on thin plastic."""

SEALED = {
    "crate66": Object(_crate66),
    "crate66_c90": Object(_crate66, 20, ring(46, 0, 90)),
    "crate66_c180": Object(_crate66, 24, ring(45, 90, 270)),
    "crate66_three": Object(_crate66, 20, ring(46, 0, 90, 180)),
    "flask33": Object(_flask33),
    "flask33_c90": Object(_flask33, 24, ring(45, 60, 150)),
    "flask33_c180": Object(_flask33, 22, ring(45, 140, 320)),
    "flask33_pair152": Object(_flask33, 24, ring(45, 20, 172)),
    "pot28": Object(_pot28),
    "pot28_c90": Object(_pot28, 20, ring(45, 240, 330)),
    "pot28_c180": Object(_pot28, 28, ring(45, 75, 255)),
    "pot28_pair157": Object(_pot28, 26, ring(45, 110, 267)),
}
"""Objects that are only reported."""

OBJECTS = {**DEVELOPMENT, **OPENED, **SEALED}
ROUND = (
    *("free24", "closed25", "wide45", "plastic40", "closed32", "cup33"),
    *("free18", "free36", "tin28", "bottle", "glass35", "pail"),
    *("tumbler", "jar42", "beaker31", "tin37"),
    *("soda34", "crock38", "flask29", "goblet33", "tub41"),
    *("free22", "free32", "free26", "can31", "cup39", "can36", "glass38"),
    *("can33", "tin41", "cup34", "glass31"),
    *("can40", "tin30", "bottle32", "cup37"),
    *("can38", "jar35", "bottle30"),
    *("flask33", "pot28"),
)
"""Bodies of revolution, and tags alone: to be read without enrolment."""

if __name__ == "__main__":
    main(OBJECTS, SWEEP)
