"""Reflectors to make: the net folds to the octahedron, the solid is closed, the size is from tip to tip."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tagid.errors import UsageError
from tagid.report.drafting import Line
from tagid.report.reflector_sheet import (
    EDGES,
    TABS,
    TRIANGLES,
    check_size,
    cross_section,
    net,
    sheet,
    solid,
    to_stl,
)
from tagid.simulate.response import Ring
from tagid.simulate.scatterers import Octahedron
from train.fullwave import Sweep, shapes, solve_response

DIHEDRAL = np.arccos(-1 / 3)
"""Between the faces of a regular octahedron, rad."""


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def folded(points: np.ndarray, triangles: tuple[tuple[int, int, int], ...]) -> np.ndarray:
    """(8, 3, 3): the triangles of a net in space, each folded along its edge with an earlier one."""
    flat = np.column_stack([points, np.zeros(len(points))])
    placed = [(triangles[0], lambda p: p)]
    out = [flat[list(triangles[0])]]
    for triangle in triangles[1:]:
        parent, move = next(item for item in placed if len(set(item[0]) & set(triangle)) == 2)
        shared = [index for index in parent if index in triangle]
        a, b = (flat[index] for index in shared)
        other = next(flat[index] for index in triangle if index not in shared)
        # Turn about the shared edge so that the new face goes below the plane of its parent.
        turn = rotation(b - a, np.pi - DIHEDRAL)
        if ((other - a) @ turn.T)[2] > 0:
            turn = turn.T

        def placing(p, a=a, turn=turn, move=move):
            return move((p - a) @ turn.T + a)

        placed.append((triangle, placing))
        out.append(placing(flat[list(triangle)]))
    return np.array(out)


@pytest.mark.parametrize("size_m", [0.02, 0.04])
def test_the_net_folds_to_an_octahedron_of_the_size(size_m: float) -> None:
    single = net(size_m)
    edge = size_m * 1e3 / np.sqrt(2)
    lengths = [np.linalg.norm(single[a] - single[b]) for a, b in EDGES]
    assert np.allclose(lengths, edge) and sorted(EDGES.values()).count(2) == 7
    # Of the ten free edges, five pairs are glued: one tab each.
    free = {pair for pair, count in EDGES.items() if count == 1}
    assert len(free) == 10 and len(TABS) == 5 and {tuple(sorted(t)) for t in TABS} < free
    faces = folded(single, TRIANGLES)
    corners = faces.reshape(-1, 3)
    tips = corners[[0]]
    for corner in corners:
        if np.linalg.norm(tips - corner, axis=1).min() > 1e-6:
            tips = np.vstack([tips, corner])
    assert len(tips) == 6
    gaps = np.sort(np.linalg.norm(tips[:, None] - tips[None], axis=2)[np.triu_indices(6, 1)])
    assert np.allclose(gaps[:12], edge) and np.allclose(gaps[12:], size_m * 1e3)
    middles = faces.mean(axis=1)
    assert len({tuple(np.round(m, 3)) for m in middles}) == 8  # no face lies on another
    # A seam's two edges come together: a tab's edge coincides with another free edge.
    tips_of = {i: faces[n][list(t).index(i)] for n, t in enumerate(TRIANGLES) for i in t}
    for start, end in TABS:
        pair = {tuple(np.round(tips_of[start], 6)), tuple(np.round(tips_of[end], 6))}
        twins = [f for f in free if {tuple(np.round(tips_of[i], 6)) for i in f} == pair]
        assert len(twins) == 2


def test_the_sheet_is_true_to_scale() -> None:
    marks = [mark for mark in sheet(0.04).marks if isinstance(mark, Line)]
    lengths = np.array([np.hypot(m.end[0] - m.start[0], m.end[1] - m.start[1]) for m in marks])
    assert np.isclose(lengths, 100).sum() == 1  # the bar
    assert np.isclose(lengths, 40).sum() == 3  # the size: two diagonals and its dimension line
    assert np.isclose(lengths, 40 / np.sqrt(2)).sum() == 17 + 4  # the net's edges, and the drawn square's
    dashed = [m for m, length in zip(marks, lengths, strict=True) if m.dashed and length < 30]
    assert len(dashed) == 7 + 5  # folds, and the edges of the tabs


def test_the_solid_is_closed_and_looks_outwards(tmp_path: Path) -> None:
    data = to_stl(0.04)
    count = struct.unpack("<I", data[80:84])[0]
    assert count == 8 and len(data) == 84 + 50 * count
    facets = np.array([struct.unpack("<12f", data[84 + 50 * i : 132 + 50 * i]) for i in range(count)])
    normals, corners = facets[:, :3], facets[:, 3:].reshape(-1, 3, 3)
    assert np.allclose(corners, solid(0.04))
    directed = [
        (tuple(np.round(c[i], 4)), tuple(np.round(c[(i + 1) % 3], 4))) for c in corners for i in range(3)
    ]
    # Every edge is passed once each way: the surface is closed and its facets agree on the outside.
    assert len(set(directed)) == 24 and all((b, a) in directed for a, b in directed)
    assert (np.einsum("nk,nk->n", normals, corners.mean(axis=1)) > 0).all()
    volume = np.einsum("nk,nk->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(40**3 / 6)
    assert np.ptp(corners.reshape(-1, 3), axis=0) == pytest.approx([40, 40, 40])


def test_the_cross_section_has_the_octahedrons_symmetry_and_the_plates_strength() -> None:
    solved = cross_section(0.04)
    assert solved.vertical.shape == solved.horizontal.shape == (7, 7)
    # Towards a tip the octahedron looks the same after a quarter turn about the line of sight.
    assert solved.vertical[:, 0] == pytest.approx(solved.horizontal[:, 0], abs=0.02)
    for table in (solved.vertical, solved.horizontal):
        assert table == pytest.approx(table[:, ::-1], abs=0.02)
    # Crossing plates of the same size, which the simulator's reflectors are, differ by 2 dB at most.
    plates = np.abs(Octahedron(0.04).scattering_length(solved.frequency_hz))
    assert solved.vertical.mean(axis=1) == pytest.approx(10 * np.log10(4 * np.pi * plates**2), abs=2.0)


@pytest.mark.parametrize("size_m", [0.012, 0.05])
def test_the_table_is_what_the_solver_gives_for_a_size(size_m: float) -> None:
    sweep = Sweep(4.3e9, 4.9e9, 2, 8, (Ring(1.0, "V"), Ring(1.0, "H")))
    solved = solve_response("octahedron", shapes.closed_octahedron(size_m, 6), sweep)
    dbsm = 20 * np.log10(np.abs(solved.scattering_length_m[1, :, 0])) + 10 * np.log10(4 * np.pi)
    table = cross_section(size_m)
    assert [table.vertical[-1, 0], table.horizontal[-1, 0]] == pytest.approx(list(dbsm), abs=0.3)


def test_the_command_writes_every_form_and_overwrites_nothing(
    tagid: Callable[..., object], tmp_path: Path
) -> None:
    words = ("layouts", "reflector", "--size", 30, "--out", "r.stl", "--out", "r.svg")
    data = tagid(*words, "--output", "json").json["data"]
    assert data["edge_mm"] == pytest.approx(30 / np.sqrt(2)) and len(data["written"]) == 2
    assert b"</svg>" in (tmp_path / "r.svg").read_bytes()
    again = tagid(*words)
    assert again.code == 1 and "--force" in again.err
    with pytest.raises(UsageError, match="tip to tip"):
        check_size(0.2)
