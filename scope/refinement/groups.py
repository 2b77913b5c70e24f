"""Points that err alike: their scatter, what they share, and how much of a direction a few of them may hold."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Bools, Ints

TRUST = 12.0  # points that the scatter of all counts for beside that of a group
WILD = 4.0  # robust deviations beyond which a residual counts as this much
FEW = 12.0  # points in effect that must hold a direction: fewer may all lie on one edge
GUESSED = 0.03  # of a guessed sigma, below which the true one is not looked for
SHARED = np.r_[3e-4, np.geomspace(5e-4, 0.3, 24)]  # mm, one sigma of what the points of one face share


def scales(deviation: Array, used: Bools, group: Ints, band: Ints, *, stated: bool) -> Array:
    """Factor (N,) by which the residuals of each point's group exceed what is claimed; a stated sigma is never made smaller.

    Parameters
    ----------
    deviation : (N,)
        Residuals over what is claimed of them.
    used : (N,)
        Those that count.
    group, band : (N,) integers
        Surface that a point is on, and how near to an edge (0 to 3): a group is one of both. The scatter of all points of the band
        stands for a dozen in each group, so that small groups are not taken at their word.
    """
    least = 1.0 if stated else GUESSED
    size = np.abs(deviation)
    pooled = np.full(4, least)
    for k in range(4):
        mine = size[used & (band == k)]
        if len(mine) > 20:
            pooled[k] = max(1.4826 * float(np.median(mine)), least)
    key = np.unique(4 * group + band, return_inverse=True)[1].ravel()
    count = np.bincount(key[used], minlength=int(key.max(initial=0)) + 1)
    middle = _medians(size[used], key[used], len(count))
    wild = WILD * np.maximum(1.4826 * middle, 0.1)[key]
    square = np.bincount(key[used], weights=np.minimum(size, wild)[used] ** 2, minlength=len(count))
    of_band = np.zeros(len(count))
    of_band[key] = pooled[band] ** 2
    return np.asarray(np.maximum(np.sqrt((TRUST * of_band + square) / (TRUST + count)), least)[key])


def _medians(values: Array, key: Ints, count: int) -> Array:
    order = np.lexsort((values, key))
    size = np.bincount(key, minlength=count)
    first = np.cumsum(size) - size
    middle = np.zeros(count)
    some = size > 0
    middle[some] = values[order][(first + size // 2)[some]]
    return middle


def bounded(jacobian: Array, weight: Array) -> Array:
    """Weights (N,) with which no direction of the pose is held by fewer than a dozen points in effect.

    Where few points hold a direction, each is let carry a twelfth of it (a bound of leverage, as in generalised M-estimators:
    F. Hampel et al., Robust Statistics, 1986, 6.3): they are believed as far as they agree, neither in full nor not at all.
    """
    weight = weight.copy()
    for _ in range(10):
        value, vector = np.linalg.eigh((jacobian.T * weight) @ jacobian)
        part = weight[:, None] * (jacobian @ vector) ** 2
        known = part.sum(axis=0)
        few = ((part**2).sum(axis=0) > known**2 / FEW) & (known > 1e-12 * max(value[-1], 1e-300))
        if not few.any():
            break
        most = np.where(few, known / FEW, np.inf)
        weight *= np.minimum(1.0, (most / np.maximum(part, 1e-300)).min(axis=1))
    return weight
