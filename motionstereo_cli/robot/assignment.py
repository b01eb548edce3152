"""Assignment of rows to columns of a table of costs: the Hungarian method.

By shortest augmenting paths (Jonker and Volgenant, 1987): rows are added one by one, and each takes
over a column of another row if that lowers the total cost.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def assignment(cost: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return pairs (row, column) of least total cost: each row or, if fewer, each column once.

    Args:
        cost: (rows, columns), finite.
    """
    if cost.shape[0] > cost.shape[1]:
        return sorted((row, column) for column, row in assignment(cost.T))
    rows, columns = cost.shape
    # One more column, the last, holds the row that is added.
    of_row, of_column = np.zeros(rows), np.zeros(columns + 1)
    owner = np.full(columns + 1, -1)
    for row in range(rows):
        owner[columns], column = row, columns
        shortest, before = np.full(columns, np.inf), np.full(columns, columns)
        reached = np.zeros(columns + 1, np.bool_)
        while owner[column] >= 0:
            reached[column] = True
            at = owner[column]
            way = cost[at] - of_row[at] - of_column[:columns]
            nearer = ~reached[:columns] & (way < shortest)
            shortest[nearer], before[nearer] = way[nearer], column
            step = np.where(reached[:columns], np.inf, shortest)
            best = int(np.argmin(step))
            of_row[owner[reached]] += step[best]
            of_column[reached] -= step[best]
            shortest[~reached[:columns]] -= step[best]
            column = best
        while column != columns:
            owner[column], column = owner[before[column]], int(before[column])
    return sorted((row, column) for column, row in enumerate(owner[:-1].tolist()) if row >= 0)
