"""How far sampling_uncertainty moves the areal parameters of a map: noise, sampling and gaps."""

from __future__ import annotations

import math

import numpy as np

from calibration.geometry import Array
from scope.heightmap import Texture
from scope.roughness.estimate import Estimate, MeasuredMap, estimate

_FEW_GAPS = 0.01  # fewer need no looking into


def sampling_uncertainty(
    measured: MeasuredMap, estimate_: Estimate, rng: np.random.Generator, *, tiles: int = 24
) -> dict[str, float]:
    """Standard uncertainty of every parameter from noise, sampling and gaps together: the delete-a-tile jackknife.

    The map is cut into tiles at least four correlation lengths wide where that leaves enough of them; the spread of the
    parameters with one tile left out at a time tells how they vary from patch to patch of this size (Efron and
    Stein 1981). Noise is part of what varies. The extremes Sp, Sv, Sz are no averages, so theirs is the spread of
    the extremes of single tiles, as Gumbel's law has it. On a regular texture all tiles are alike and hide what gaps do:
    that is found by cutting the map's own gaps into it once more, elsewhere.
    """
    labels, count = _tiles(measured.z, _correlation_lengths(estimate_.texture), measured.pitch, tiles)
    found: list[dict[str, float]] = []
    extremes: list[dict[str, float]] = []
    for tile in range(count):
        inside = labels == tile
        known = measured.z[inside]
        known = known[np.isfinite(known)]
        if len(known) < 10:
            continue
        extremes.append({"Sp": float(known.max()), "Sv": float(-known.min()), "Sz": float(np.ptp(known))})
        found.append(estimate(measured.part(~inside), with_raw=False).clean)
    if len(found) < 4:
        return dict.fromkeys(estimate_.clean, math.nan)
    spread = {}
    for name in estimate_.clean:
        values = np.array([one[name] for one in found])
        values = values[np.isfinite(values)]
        if len(values) < 0.5 * len(found):
            spread[name] = math.nan
        else:
            spread[name] = few(len(values)) * float(np.sqrt((len(values) - 1) * np.mean((values - values.mean()) ** 2)))
    for name in ("Sp", "Sv", "Sz"):
        spread[name] = float(np.std([one[name] for one in extremes], ddof=1))
    for name, moved in _gap_spread(measured, estimate_, rng).items():
        spread[name] = math.hypot(spread[name], moved)
    if math.isfinite(estimate_.clean["Std"]):
        turned = np.exp(2j * np.radians([one["Std"] for one in found if math.isfinite(one["Std"])]))
        centred = np.angle(turned / turned.mean()) / 2.0
        spread["Std"] = float(np.degrees(np.sqrt((len(turned) - 1) * np.mean(centred**2))))
    return spread


def few(parts: int) -> float:
    """Factor by which the spread over few parts is enlarged: the standard deviation of Student's t (JCGM 101, 6.4.9)."""
    return math.sqrt((parts - 1.0) / (parts - 3.0)) if parts > 3 else math.inf


def _gap_spread(
    measured: MeasuredMap, estimate_: Estimate, rng: np.random.Generator, *, draws: int = 4
) -> dict[str, float]:
    """Root mean square change (by parameter) that the map's own gaps make when they are cut again at a random shift."""
    known = np.isfinite(measured.z)
    if known.mean() > 1.0 - _FEW_GAPS:
        return {}
    changes: dict[str, list[float]] = {name: [] for name in estimate_.clean if name != "Std"}
    for _ in range(draws):
        shift = (int(rng.integers(known.shape[0])), int(rng.integers(known.shape[1])))
        again = estimate(measured.part(np.roll(known, shift, axis=(0, 1))), with_raw=False).clean
        for name, found in changes.items():
            change = again[name] - estimate_.clean[name]
            if math.isfinite(change):
                found.append(change)
    return {name: math.sqrt(sum(c * c for c in found) / len(found)) for name, found in changes.items() if found}


def _correlation_lengths(found: Texture) -> tuple[float, float]:
    """Lags (mm) down and along at which the correlation first falls to 0.2, the map's own reach where it does not."""
    lengths = []
    for axis in (0, 1):
        lag, correlation = found.acf.profile(axis)
        below = np.flatnonzero(correlation[1:] <= 0.2)
        lengths.append(float(lag[below[0] + 1]) if len(below) else float(lag[-1]))
    return lengths[0], lengths[1]


def _tiles(z: Array, lengths: tuple[float, float], pitch: tuple[float, float], most: int) -> tuple[Array, int]:
    """Label (rows, columns) of each height's tile, and how many tiles there are: 8 to about ``most``."""
    room = [max(1.0, n * p / max(4.0 * length, 1e-12)) for n, p, length in zip(z.shape, pitch, lengths, strict=True)]
    size = [n * p for n, p in zip(z.shape, pitch, strict=True)]
    while room[0] * room[1] > most:
        larger = 0 if size[1] / room[1] >= size[0] / room[0] and room[0] > 1.0 else 1
        room[larger] = max(1.0, room[larger] * 0.95) if room[larger] > 1.0 else room[larger]
        if room[larger] == 1.0:
            room[1 - larger] *= 0.95
    counts = [max(1, int(r)) for r in room]
    while counts[0] * counts[1] < 8:
        counts[0 if size[0] / counts[0] >= size[1] / counts[1] else 1] += 1
    rows = np.minimum(np.arange(z.shape[0]) * counts[0] // z.shape[0], counts[0] - 1)
    columns = np.minimum(np.arange(z.shape[1]) * counts[1] // z.shape[1], counts[1] - 1)
    return rows[:, None] * counts[1] + columns[None, :], counts[0] * counts[1]
