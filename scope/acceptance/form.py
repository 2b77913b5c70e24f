"""Spread of points about a fitted shape: all but a share of outliers, 95 %, or 25 representative points; and what noise makes of it."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Bools

_DRAWS = 60
_MOST = 20_000  # points of a draw
_RINGS = ((0.0, 1), (22.5, 4), (45.0, 8), (67.5, 4), (90.0, 8))  # polar angle in degrees over a hemisphere, and points


def spread(residual: Array, left_out: float) -> float:
    """Width, mm, of the narrowest interval that holds all residuals (N,) but the share ``left_out``, rounded down to points.

    0 leaves none out; 0.05 is the spread of 95 %. NaN without residuals.
    """
    if len(residual) == 0:
        return float("nan")
    ordered = np.sort(residual)
    out = int(left_out * len(ordered) + 1e-9)
    return float((ordered[len(ordered) - out - 1 :] - ordered[: out + 1]).min())


def representative(direction: Array, residual: Array, pole: Array) -> Array:
    """Residuals (25,) mm of representative points: means of the nearest about directions spread over the cap that was seen.

    Parameters
    ----------
    direction : (N, 3)
        Unit, from the centre to each point.
    residual : (N,) mm
    pole : (3,)
        Middle of the cap, any length.

    Returns
    -------
    (25,) mm
        The pattern is the usual one of tactile tests (1, 4, 8, 4 and 8 points on circles), drawn together to the cap.
    """
    pole = pole / np.linalg.norm(pole)
    axes = np.linalg.svd(pole[None])[2][1:]
    cap = float(np.quantile(np.arccos(np.clip(direction @ pole, -1.0, 1.0)), 0.98)) * 0.95
    found = []
    near = max(5, min(50, len(residual) // 100))
    for ring, (polar, count) in enumerate(_RINGS):
        angle = cap * polar / 90.0
        for k in range(count):
            turn = 2.0 * np.pi * (k + 0.5 * (ring % 2)) / count
            at = np.cos(angle) * pole + np.sin(angle) * (np.cos(turn) * axes[0] + np.sin(turn) * axes[1])
            found.append(float(residual[np.argpartition(-(direction @ at), near - 1)[:near]].mean()))
    return np.array(found)


def expected_spread(
    design: Array, across: Array, sigma: Array, shared: Array, left_out: float
) -> tuple[float, float] | None:
    """Spread, mm, that a cloud's own sigma and calibration explain, and its standard deviation; None where it tells none.

    Parameters
    ----------
    design : (N, P)
        Derivatives of the residuals by the parameters of the fit.
    across : (N,)
        By how much an error along the sighting ray moves the residual.
    sigma : (N,) mm
        Error of each point along the ray, one sigma.
    shared : (N, K) mm
        What K errors of the calibration, one sigma each, do to the residual.
    left_out : float
        As in `spread`.

    Notes
    -----
    Monte Carlo of 60 draws, neighbours' noise taken to be independent. With more than 20,000 points every k-th is drawn.
    """
    if not (np.isfinite(sigma).any() and np.nanmax(sigma) > 0):
        return None
    step = max(1, len(sigma) // _MOST)
    j, along = design[::step], across[::step]
    noise, calibration = np.nan_to_num(sigma[::step]) * along, np.nan_to_num(shared[::step])
    q = np.linalg.qr(j[:, np.linalg.norm(j, axis=0) > 0])[0]
    rng = np.random.default_rng(0)
    found = np.empty(_DRAWS)
    for k in range(_DRAWS):
        error = noise * rng.normal(size=len(noise)) + calibration @ rng.normal(size=calibration.shape[1])
        found[k] = spread(error - q @ (q.T @ error), left_out)
    return float(found.mean()), float(found.std(ddof=1))


def facing(points: Array, centre: Array, camera: Array | None) -> Bools:
    """Points (N, 3) on the side of a sphere that a camera (N, 3) sees; all where it is not known."""
    if camera is None:
        return np.ones(len(points), dtype=np.bool_)
    return np.asarray(((points - centre) * (camera - points)).sum(axis=1) > 0.0)
