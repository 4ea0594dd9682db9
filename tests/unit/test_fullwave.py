"""The full-wave solver against closed forms: Mie series, conservation of energy, the slab, Kirchhoff's
law."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.simulate.response import Ring
from tagid.simulate.response_file import read_response
from tests.benchmarks.provenance import SHARED
from train.fullwave import Efie, Mesh, Sweep, ring_antennas, shapes, solve_response
from train.fullwave.efie import dipole_field
from train.fullwave.mesh import HalfFunction
from train.fullwave.mie import sphere_backscatter
from train.fullwave.singular import RULE_7, static_potentials

FULLWAVE = SHARED / "fullwave" / "responses"
FAR_M = 300.0
K = 2 * np.pi * 4e9 / SPEED_OF_LIGHT
UP = np.array([[0.0, 0.0, 1.0]])


def scattering_length(
    equation: Efie, k: float, direction: np.ndarray, polarisation: np.ndarray = UP
) -> np.ndarray:
    """b (n,) towards far antennas in directions (n, 3)."""
    antennas = FAR_M * direction
    s = equation.monostatic(k, antennas, np.broadcast_to(polarisation, antennas.shape))
    return s * FAR_M**2 * np.exp(2j * k * FAR_M)


def db(power_ratio: np.ndarray) -> np.ndarray:
    return 20 * np.log10(np.abs(power_ratio))


def cut(corners: np.ndarray, times: int) -> np.ndarray:
    """(4^times, 3, 3): a triangle in equal parts."""
    for _ in range(times):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        d, e, f = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = np.concatenate([np.stack(t, 1) for t in ((a, d, f), (d, b, e), (f, e, c), (d, e, f))])
    return corners


@pytest.mark.parametrize("point", [(0.3, 0.2, 0.15), (1.4, -0.3, 0.0), (-0.2, 0.4, -0.6)])
def test_static_potentials_are_the_integrals(point: tuple[float, float, float]) -> None:
    turned = Rotation.from_rotvec([0.3, -0.8, 0.5])
    triangle, r = turned.apply([[0, 0, 0], [1.0, 0.1, 0], [0.2, 0.9, 0]]), turned.apply(point)
    parts = cut(triangle[None], 6)
    area = 0.5 * np.linalg.norm(np.cross(parts[:, 1] - parts[:, 0], parts[:, 2] - parts[:, 0]), axis=1)
    where = np.einsum("qi,tic->tqc", RULE_7[0], parts)
    weight = RULE_7[1] * area[:, None] / np.linalg.norm(where - r, axis=2)
    scalar, vector = static_potentials(r[None, None], triangle[None])
    assert scalar[0, 0] == pytest.approx(weight.sum(), rel=1e-6)
    np.testing.assert_allclose(vector[0, 0], np.einsum("tq,tqc->c", weight, where), rtol=1e-5, atol=1e-8)


def edges_of(mesh: Mesh) -> np.ndarray:
    """(3 triangles, 2) ends of every triangle's edges, the lower number first."""
    ends = np.stack([np.roll(mesh.triangles, -1, 1), np.roll(mesh.triangles, -2, 1)], 2).reshape(-1, 2)
    return np.sort(ends, axis=1)


def test_currents_obey_kirchhoff_where_plates_cross() -> None:
    mesh = shapes.octahedron(0.02, 3)
    half = HalfFunction.of(mesh)
    # Three half-axes both ways, three edges on each, with four triangles: three functions a junction.
    current = np.random.default_rng(1).standard_normal(len(half.plus))
    # A half's flow through its edge is 1 per length, outwards; the other half flows in.
    flow = np.zeros(3 * len(mesh.triangles))
    np.add.at(flow, half.plus, current)
    np.add.at(flow, half.minus, -current)
    _, edge, count = np.unique(edges_of(mesh), axis=0, return_inverse=True, return_counts=True)
    total = np.bincount(edge.ravel(), flow)
    np.testing.assert_allclose(total, 0, atol=1e-12)  # at junctions and, where no current flows, at the rim
    assert (flow.reshape(-1)[count[edge.ravel()] == 1] == 0).all()
    assert (flow.reshape(-1)[count[edge.ravel()] > 1] != 0).all()


def test_mie_series_has_its_limits() -> None:
    radius = 0.02
    small = np.array([0.05]) / radius
    # Rayleigh: sigma = 9 pi a^2 (ka)^4, from the electric and the magnetic dipole together.
    cross_section = 4 * np.pi * np.abs(sphere_backscatter(radius, small)) ** 2
    assert cross_section == pytest.approx(9 * np.pi * radius**2 * 0.05**4, rel=0.01)
    large = np.array([60.0]) / radius
    optics = -radius / 2 * np.exp(2j * 60.0)
    assert abs(sphere_backscatter(radius, large) / optics - 1)[0] < 0.03


def test_a_sphere_agrees_with_mie() -> None:
    """Amplitude and phase; the faceted sphere is compared with the sphere of its volume."""
    mesh = shapes.sphere(0.02, 5)
    a, b, c = mesh.corners.swapaxes(0, 1)
    volume = np.abs(np.einsum("ti,ti->t", a, np.cross(b, c)))
    radius = (volume.sum() / 6 * 3 / (4 * np.pi)) ** (1 / 3)
    k = 2 * np.pi * 3.2e9 / SPEED_OF_LIGHT
    b = scattering_length(Efie(mesh), k, np.array([[1.0, 0, 0]]))[0]
    exact = sphere_backscatter(radius, np.array(k))
    assert abs(db(b / exact)) < 0.15
    assert abs(np.angle(b / exact)) < np.deg2rad(1.0)


@pytest.mark.parametrize("lossy", [False, True])
def test_energy_is_conserved(lossy: bool) -> None:
    """Optical theorem: sigma_ext = -(4 pi / k) Im F(forward) for exp(+j omega t), F the scattering amplitude.

    Without loss it equals the scattered power, summed over directions and both polarisations; with loss it is
    larger. Wrong signs, factors and junctions all break it.
    """
    mesh = shapes.octahedron(0.03, 3)
    if lossy:
        mesh = Mesh(mesh.vertices, mesh.triangles, np.full(len(mesh.triangles), 0.02 - 0.03j))
    equation = Efie(mesh)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    azimuth = 2 * np.pi * np.arange(16) / 16
    sine = np.sqrt(1 - nodes**2)
    parts = [np.outer(sine, np.cos(azimuth)), np.outer(sine, np.sin(azimuth)), np.outer(nodes, np.ones(16))]
    direction = np.stack(parts, -1).reshape(-1, 3)
    solid_angle = np.repeat(weights * 2 * np.pi / 16, 16)
    across = np.cross([0.0, 0, 1], direction)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upright = np.cross(direction, across)
    from_x = equation.excitation(K, np.array([[FAR_M, 0, 0]]), UP)
    current = equation.currents(K, from_x)[:, 0]

    def amplitude(where: np.ndarray, polarisation: np.ndarray) -> np.ndarray:
        seen = equation.excitation(K, FAR_M * where, polarisation).T @ current
        return -seen * np.exp(2j * K * FAR_M) * FAR_M**2

    scattered = sum(solid_angle @ np.abs(amplitude(direction, p)) ** 2 for p in (across, upright))
    extinction = -4 * np.pi / K * amplitude(np.array([[-1.0, 0, 0]]), UP)[0].imag
    if lossy:
        assert extinction > 1.5 * scattered
    else:
        assert extinction == pytest.approx(scattered, rel=2e-3)


def test_the_matrix_is_symmetric_so_that_reciprocity_holds() -> None:
    mesh = Mesh.join(
        shapes.can(0.02, 0.03, 0.009), shapes.octahedron(0.02, 2).moved((0.035, 0.0, 0.004), 0.3)
    )
    matrix = Efie(mesh).matrix(K)
    np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-9 * np.abs(matrix).max())


def test_a_dielectric_plate_reflects_as_a_slab() -> None:
    """At normal incidence a plate echoes the slab's reflection coefficient times the metal plate's echo."""
    eps, thickness, side = 2.8, 0.003, 0.11
    metal = Efie(shapes.plate(side, side, 0.0115))
    sheet = Efie(shapes.plate(side, side, 0.0115, shapes.sheet(eps, thickness)))
    east = np.array([[1.0, 0, 0]])
    ratio = scattering_length(sheet, K, east)[0] / scattering_length(metal, K, east)[0]
    r = (1 - np.sqrt(eps)) / (1 + np.sqrt(eps))
    through = np.exp(-2j * K * np.sqrt(eps) * thickness)
    slab = r * (1 - through) / (1 - r**2 * through) * np.exp(1j * K * thickness)  # referred to its middle
    # The metal's coefficient is -1; diffraction at the rim of a plate of 1.5 wavelengths differs a little.
    assert abs(db(ratio / -slab)) < 0.9
    assert abs(np.angle(ratio / -slab)) < np.deg2rad(8)


def test_a_graded_octahedron_has_converged() -> None:
    around = np.deg2rad([0, 20, 45])
    directions = np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    few, many, even = (
        scattering_length(Efie(shapes.octahedron(0.02, n, grading)), K, directions)
        for n, grading in ((4, 2.5), (6, 2.5), (3, 1.0))
    )
    assert np.abs(db(few / many)).max() < 0.15
    assert db(even / many).mean() < -0.6  # what the grading is for


def test_turning_the_object_equals_turning_the_antennas_back() -> None:
    mesh = shapes.tag(0.03, np.array([[0.045, 0.0], [0.0, 0.045]]), 2)
    sweep = Sweep(3.9e9, 4.1e9, 2, 24, (Ring(1.0, "V"), Ring(0.8, "H", 0.2)))
    plain = solve_response("pair", mesh, sweep).scattering_length_m
    turned = solve_response("pair", mesh.moved(turn_rad=2 * np.pi * 5 / 24), sweep).scattering_length_m
    np.testing.assert_allclose(turned, np.roll(plain, 5, axis=2), atol=1e-4 * np.abs(plain).max())


def test_the_field_of_a_dipole_obeys_maxwell_near_it_too() -> None:
    """Divergence zero and the wave equation, by differences; one sign wrong in the near terms breaks them."""
    p = np.array([[0.0, 0.6, 0.8]])
    at = np.array([0.04, 0.01, -0.03])
    h = 1e-3

    def field(offset: np.ndarray) -> np.ndarray:
        return dipole_field(K, (at + offset)[None], np.zeros((1, 3)), p)[:, 0, 0]

    steps = h * np.eye(3)
    divergence = sum((field(steps[c]) - field(-steps[c]))[c] for c in range(3)) / (2 * h)
    laplacian = sum(field(s) + field(-s) - 2 * field(0 * s) for s in steps) / h**2
    scale = np.linalg.norm(field(np.zeros(3)))
    assert abs(divergence) < 0.01 * K * scale
    np.testing.assert_allclose(laplacian, -(K**2) * field(np.zeros(3)), atol=0.02 * K**2 * scale)


@pytest.mark.skipif(not FULLWAVE.is_dir(), reason="the full-wave responses are not in the shared data folder")
@pytest.mark.parametrize("name", ["free20_one", "free20_c90"])
def test_the_shared_responses_are_reproduced(name: str) -> None:
    """Another solver with a mesh of the same fineness: amplitude and phase at 1 m, both polarisations."""
    theirs = read_response(FULLWAVE / f"{name}.npz")
    positions = np.array([[0.045, 0.0], [0.0, 0.045]]) if name.endswith("c90") else np.zeros((1, 2))
    equation = Efie(shapes.tag(0.02, positions, 3, 1.0))
    k = float(theirs.wavenumber[20])
    for i in (1, 3):
        ring = theirs.rings[i]
        b = equation.monostatic(k, *ring_antennas(ring, 12)) * ring.range_m**2 * np.exp(2j * k * ring.range_m)
        there = theirs.scattering_length_m[20, i, ::6]
        assert np.abs(db(b / there)).max() < 0.1
        assert np.abs(b - there).max() < 0.01 * np.abs(there).max()


def test_the_phase_refers_to_the_axis_and_a_shift_towards_the_antenna_advances_it() -> None:
    sweep = Sweep(3.9e9, 4.1e9, 2, 4, (Ring(200.0, "V"), Ring(201.0, "V")))
    meshes = (shapes.octahedron(0.02, 2).moved((x, 0.0, 0.0)) for x in (0.0, 0.01))
    still, near = (solve_response("one", mesh, sweep).scattering_length_m[0, :, 0] for mesh in meshes)
    k = 2 * np.pi * 3.9e9 / SPEED_OF_LIGHT
    assert still[1] / still[0] == pytest.approx(1, abs=5e-3)
    assert near / still == pytest.approx(np.exp(2j * k * 0.01), rel=5e-3)


def test_antennas_of_a_ring_lie_across_the_line_of_sight() -> None:
    for ring in (Ring(0.8, "V", 0.3), Ring(0.8, "H", -0.2)):
        position, polarisation = ring_antennas(ring, 7)
        np.testing.assert_allclose(np.einsum("ic,ic->i", position, polarisation), 0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(polarisation, axis=1), 1)
        upward = polarisation[:, 2]
        assert (upward > 0.9).all() if ring.polarisation == "V" else (upward == 0).all()


@pytest.mark.parametrize(
    "m",
    [
        shapes.can(0.03, 0.05, 0.012),
        shapes.helmet((0.07, 0.09, 0.08), 0.02, 0.02),
        shapes.box((0.05, 0.06, 0.07), 0.012),
        shapes.handle(0.03),
    ],
    ids=["can", "helmet", "box", "handle"],
)
def test_surfaces_are_closed_but_for_their_opening(m: Mesh) -> None:
    """Edges with one triangle form closed loops, at the height of the opening or along the strip's sides."""
    edges, count = np.unique(edges_of(m), axis=0, return_counts=True)
    assert count.max() == 2
    rim = edges[count == 1]
    assert (np.bincount(rim.ravel())[np.unique(rim)] == 2).all()
    z = m.vertices[np.unique(rim), 2]
    assert np.ptp(z) < 1e-9 or len(np.unique(np.abs(m.vertices[np.unique(rim), 1]).round(6))) <= 2


def test_bad_meshes_are_refused() -> None:
    triangle = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]], dtype=np.float64)
    with pytest.raises(DataError, match="no current"):
        Efie(Mesh.of(triangle, np.array([[0, 1, 2]])))
    with pytest.raises(DataError, match="no area"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), np.zeros(1, complex))
    with pytest.raises(DataError, match="finite"):
        Mesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), np.zeros(1, complex))
    with pytest.raises(DataError, match="wavelength"):
        solve_response("coarse", shapes.plate(0.1, 0.1, 0.05))
    with pytest.raises(DataError, match="touches"):
        equation = Efie(shapes.plate(0.02, 0.02, 0.01))
        equation.monostatic(K, equation.points[:1] + 1e-4, UP)
