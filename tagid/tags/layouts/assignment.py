"""The pairing of two sets of points with the least sum of costs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def least_assignment(cost: NDArray[np.floating]) -> NDArray[np.intp]:
    """(rows,) column of each row such that no column is taken twice and the sum of the costs is least.

    Shortest augmenting paths with potentials (R. Jonker, A. Volgenant, Computing 38, 1987).

    Args:
        cost: (rows, columns) with no more rows than columns.
    """
    rows, columns = cost.shape
    by_row, by_column = np.zeros(rows), np.zeros(columns)
    owner = np.full(columns, -1)
    for row in range(rows):
        reach = np.full(columns, np.inf)
        before = np.full(columns, -1)
        done = np.zeros(columns, dtype=bool)
        here, last, length = row, -1, 0.0
        while True:
            step = length + cost[here] - by_row[here] - by_column
            nearer = ~done & (step < reach)
            reach[nearer], before[nearer] = step[nearer], last
            last = int(np.argmin(np.where(done, np.inf, reach)))
            length = float(reach[last])
            done[last] = True
            if owner[last] < 0:
                break
            here = int(owner[last])
        # Potentials keep the reduced costs of all pairs non-negative, and those of assigned pairs zero.
        by_row[row] += length
        for column in np.flatnonzero(done):
            if owner[column] >= 0:
                by_row[owner[column]] += length - reach[column]
            by_column[column] -= length - reach[column]
        while last >= 0:
            previous = int(before[last])
            owner[last] = row if previous < 0 else owner[previous]
            last = previous
    assigned = np.empty(rows, dtype=np.intp)
    taken = np.flatnonzero(owner >= 0)
    assigned[owner[taken]] = taken
    return assigned
