"""Symmetric matrices, many at once: an array for each entry, so that every step runs over all.

A matrix of d channels is packed as its lower triangle, row by row: (d (d + 1) / 2, ...).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from failuretwin.core.types import FloatArray, IntArray


@lru_cache
def entries(channels: int) -> tuple[IntArray, IntArray]:
    """Return row and column of each entry, (entry,) each."""
    rows, columns = np.tril_indices(channels)
    return rows, columns


@lru_cache
def places(channels: int) -> IntArray:
    """Return the index of each entry of a packed matrix, (channel, channel)."""
    found = np.zeros((channels, channels), dtype=np.int64)
    rows, columns = entries(channels)
    found[rows, columns] = found[columns, rows] = np.arange(len(rows))
    return found


def packed(matrix: FloatArray) -> FloatArray:
    """Return matrices (..., channel, channel) with the entries of their lower triangle first."""
    return np.stack([matrix[..., i, j] for i, j in zip(*entries(matrix.shape[-1]), strict=True)])


def unpacked(matrix: FloatArray) -> FloatArray:
    """Return packed matrices as (..., channel, channel)."""
    channels = int(np.sqrt(2 * len(matrix)))
    return np.moveaxis(matrix[places(channels)], (0, 1), (-2, -1))


def inverse(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return inverse (packed) and log determinant of positive definite matrices.

    One sweep a channel k: with b = A_kk,
    A_ij <- A_ij - A_ik A_jk / b,    A_ik <- A_ik / b,    A_kk <- -1 / b    make -A^-1 of A.

    Args:
        matrix: Packed, (entry, ...).
    """
    channels = int(np.sqrt(2 * len(matrix)))
    at, entry = places(channels).tolist(), list(matrix)
    determinant = np.ones(matrix.shape[1:])
    for k in range(channels):
        pivot = entry[at[k][k]]
        determinant = determinant * pivot
        factor = 1.0 / pivot
        others = [i for i in range(channels) if i != k]
        column = {i: entry[at[i][k]] for i in others}
        for i in others:
            scaled = column[i] * factor
            for j in others:
                if j <= i:
                    entry[at[i][j]] = entry[at[i][j]] - scaled * column[j]
            entry[at[i][k]] = scaled
        entry[at[k][k]] = -factor
    found = np.stack(entry)
    return np.negative(found, out=found), np.log(determinant)


def times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return packed matrices times vectors, (channel, ...)."""
    at = places(len(vector)).tolist()
    rows = []
    for row in at:
        total = matrix[row[0]] * vector[0]
        for j in range(1, len(row)):
            total = total + matrix[row[j]] * vector[j]
        rows.append(total)
    return np.stack(rows)


def dot(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the products of vectors (channel, ...), (...)."""
    total = one[0] * other[0]
    for i in range(1, len(one)):
        total = total + one[i] * other[i]
    return total


def outer(vector: FloatArray) -> FloatArray:
    """Return v v^T of vectors (channel, ...), packed."""
    rows, columns = entries(len(vector))
    return np.asarray(vector[rows] * vector[columns])


def identity(channels: int) -> FloatArray:
    """Return the identity, packed, (entry,)."""
    rows, columns = entries(channels)
    return np.asarray(rows == columns, dtype=np.float64)
