"""Sums of products of Chebyshev polynomials, compiled: values and slopes at many points in one pass.

`calibration.rays.polynomial` builds designs, which least squares needs; a sum that is evaluated for every pixel of a scan needs
none of their rows. Importing this module loads numba.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.compiled import compiled
from calibration.geometry import Array

_LANES = 64  # points side by side


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """K functions of (s, t): f_k = sum over i, j of table[k, i, j] T_i(t) T_j(s)."""

    table: Array  # (K, n, n)

    @classmethod
    def of_terms(cls, terms: Sequence[tuple[int, int]], coefficients: Array) -> Series:
        """Series of ``coefficients`` (d, K) of the products whose orders (of t, of s) are ``terms``."""
        orders = np.array(terms)
        table = np.zeros((coefficients.shape[1], orders.max() + 1, orders.max() + 1))
        table[:, orders[:, 0], orders[:, 1]] = coefficients.T
        return cls(table)

    @classmethod
    def of_form(
        cls, rows: Sequence[tuple[int, int]], columns: Sequence[tuple[int, int]], matrix: Array, size: int
    ) -> Series:
        """Series of the bilinear form ``p(rows)' matrix p(columns)`` of two sets of products, of orders below ``size``.

        Products are taken apart by T_a T_b = (T_a+b + T_|a-b|) / 2, so that the form costs its distinct terms only.
        """
        a, b = np.array(rows)[:, None, :], np.array(columns)[None, :, :]
        table = np.zeros((1, size, size))
        for in_t in (a[..., 0] + b[..., 0], np.abs(a[..., 0] - b[..., 0])):
            for in_s in (a[..., 1] + b[..., 1], np.abs(a[..., 1] - b[..., 1])):
                np.add.at(table[0], (in_t, in_s), matrix / 4.0)
        return cls(table)

    @classmethod
    def joined(cls, parts: Sequence[Series]) -> Series:
        """All functions of several series, in order."""
        size = max(part.table.shape[1] for part in parts)
        padded = [np.pad(part.table, ((0, 0), *(((0, size - part.table.shape[1]),) * 2))) for part in parts]
        return cls(np.concatenate(padded))

    def values(self, square: Array) -> Array:
        """The functions (K, N) at points (N, 2) of the square."""
        out = np.empty((len(self.table), len(square)))
        _sum(self.table, np.ascontiguousarray(square), out, out[:0], out[:0], False)
        return out

    def values_and_slopes(self, square: Array) -> tuple[Array, Array, Array]:
        """The functions and their derivatives by s and by t, each (K, N), at points (N, 2) of the square."""
        out, by_s, by_t = (np.empty((len(self.table), len(square))) for _ in range(3))
        _sum(self.table, np.ascontiguousarray(square), out, by_s, by_t, True)
        return out, by_s, by_t


@compiled
def _sum(table: Array, square: Array, out: Array, by_s: Array, by_t: Array, slopes: bool) -> None:
    """T_n = 2 x T_n-1 - T_n-2 and its derivative, point by point in lanes; terms that are zero cost nothing."""
    count, size, _ = table.shape
    points = len(square)
    basis = np.empty((2, size, _LANES))
    slope = np.zeros((2, size, _LANES))
    row, row_slope = np.empty(_LANES), np.empty(_LANES)
    total, total_s, total_t = np.empty(_LANES), np.empty(_LANES), np.empty(_LANES)
    last = np.zeros((count, size), np.int64)  # terms in each row of the table
    for k in range(count):
        for i in range(size):
            for j in range(size):
                if table[k, i, j] != 0.0:
                    last[k, i] = j + 1
    for start in range(0, points, _LANES):
        lanes = min(_LANES, points - start)
        for axis in range(2):
            for m in range(_LANES):
                x = square[start + min(m, lanes - 1), axis]
                basis[axis, 0, m] = 1.0
                if size > 1:
                    basis[axis, 1, m] = x
                    slope[axis, 1, m] = 1.0
            for n in range(2, size):
                for m in range(_LANES):
                    x = basis[axis, 1, m]
                    basis[axis, n, m] = 2.0 * x * basis[axis, n - 1, m] - basis[axis, n - 2, m]
                if slopes:
                    for m in range(_LANES):
                        x = basis[axis, 1, m]
                        slope[axis, n, m] = (
                            2.0 * basis[axis, n - 1, m] + 2.0 * x * slope[axis, n - 1, m] - slope[axis, n - 2, m]
                        )
        for k in range(count):
            for m in range(_LANES):
                total[m], total_s[m], total_t[m] = 0.0, 0.0, 0.0
            for i in range(size):
                if last[k, i] == 0:
                    continue
                for m in range(_LANES):
                    row[m], row_slope[m] = 0.0, 0.0
                for j in range(last[k, i]):
                    c = table[k, i, j]
                    for m in range(_LANES):
                        row[m] += c * basis[0, j, m]
                    if slopes:
                        for m in range(_LANES):
                            row_slope[m] += c * slope[0, j, m]
                for m in range(_LANES):
                    total[m] += row[m] * basis[1, i, m]
                if slopes:
                    for m in range(_LANES):
                        total_s[m] += row_slope[m] * basis[1, i, m]
                        total_t[m] += row[m] * slope[1, i, m]
            for m in range(lanes):
                out[k, start + m] = total[m]
            if slopes:
                for m in range(lanes):
                    by_s[k, start + m] = total_s[m]
                    by_t[k, start + m] = total_t[m]
