"""A turntable scan that contradicts itself: turned the other way, or by another step than the capture says.

Distance from the axis and height along it do not depend on the angle, so that they can be compared without trusting it.
Two things show a wrong angle: after a full turn every line of the image must see the same place again, and a flat base that is
not quite square to the axis must come out flat. Weakness: a sheet of light through the axis shows a table that is turned the
other way as an exact mirror image, a base square to the axis is flat however it turns, and two turns taken for one repeat as one
does: these are not seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.geometry import Array, Bools
from ranging.motion import Motion, Turntable
from scope.cloud import ScanCloud, lattice_lines
from scope.scanning.statistics import Scan

FACTORS = (
    -1.0,
    2.0,
    0.5,
    3.0,
    1 / 3,
    1.5,
    2 / 3,
    4.0,
    0.25,
)  # of the stated angle, that people take for it; and each reversed
_TURN = 2.0 * np.pi
_LEAST_PAIRS = 200  # pairs of points a full turn apart, or points on a base
_MOST = 200_000  # points that are looked at
_NOISES = 10.0  # sigma, beyond which places differ
_PART = 0.01  # of the radius of the scan, by which a place differs at least
_BY_EDGES = 0.1  # share of the places that may differ, since frames fall beside each other at edges
_BETTER = 3.0  # times flatter, or nearer, that another angle must come out
_BASE = 0.08  # of the radius of the scan: half the height within which points may be those of the base


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Points of a turntable scan, told by what does not depend on the angle, and by the angle."""

    s: Array  # (N,) rad, stated position of the table
    line: Array  # (N,) line of the image
    radius: Array  # (N,) mm from the axis
    height: Array  # (N,) mm along the axis
    azimuth: Array  # (N,) rad about the axis, in C: before anything was turned back
    sigma: float  # mm, median


def turn_trouble(cloud: ScanCloud, motion: Turntable) -> str:
    """One sentence where a turntable scan contradicts the angles it was put together with; empty where nothing shows.

    Parameters
    ----------
    cloud : ScanCloud
        The scan, with frames and pixels.
    motion : Turntable
        How its frames were put together.
    """
    seen = _seen(cloud, motion)
    if seen is None:
        return ""
    return _after_a_turn(seen) or _base(seen)


def with_turn_trouble(found: Scan, motion: Motion) -> Scan:
    """The scan, with what its overlap says against the motion among its ``troubles``."""
    trouble = turn_trouble(found.cloud, motion) if isinstance(motion, Turntable) else ""
    return replace(found, troubles=(*found.troubles, trouble)) if trouble else found


def _seen(cloud: ScanCloud, motion: Turntable) -> _Seen | None:
    if len(cloud) == 0:
        return None
    some = np.flatnonzero(cloud.laser == np.bincount(cloud.laser).argmax())
    lines = lattice_lines(cloud)
    if len(some) > _MOST:  # whole lines, since a line is compared with itself
        kept = np.unique(lines[some])
        some = some[np.isin(lines[some], kept[:: len(some) // _MOST + 1])]
    frames, inverse = np.unique(cloud.frame[some], return_inverse=True)
    if len(frames) < 4:
        return None
    angles = np.array([motion.sign * motion.positions.at(int(frame)) for frame in frames])
    axis = motion.axis / np.linalg.norm(motion.axis)
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    offset = cloud.points[some] - motion.point
    x, y, height = offset @ first, offset @ np.cross(axis, first), offset @ axis
    sigma = float(np.nanmedian(cloud.sigma[some])) if np.isfinite(cloud.sigma[some]).any() else 0.0
    s = angles[inverse]
    return _Seen(s, lines[some].astype(np.float64), np.hypot(x, y), height, np.arctan2(y, x) + s, max(sigma, 1e-3))


def _after_a_turn(seen: _Seen) -> str:
    """What the lines of the image saw before and after the full turn that the positions state."""
    if (seen.line < 0).any():
        return ""
    stated = _repeats(seen, _TURN)
    if stated is None:
        return ""
    usual = [d for turn in np.linspace(0.13, 0.87, 7) if (d := _repeats(seen, turn * _TURN)) is not None]
    if not usual or stated <= max(_BY_EDGES, 0.5 * float(np.median(usual))):
        return ""  # it does repeat, or all angles look alike
    found = {}
    for factor in (abs(f) for f in FACTORS):
        distance = _repeats(seen, _TURN / factor)
        if factor != 1.0 and distance is not None and distance < stated / _BETTER:
            found[factor] = distance
    told = f"after the full turn that its positions state, the object is not where it was ({100 * stated:.0f} % of what stands out differs)"
    if not found:
        return f"{told}: are step and axis right?"
    best = min(found, key=lambda factor: found[factor])
    return (
        f"{told}, but after {360.0 / best:.0f} stated degrees it is: are the steps {_times(best)} as large as stated?"
    )


def _repeats(seen: _Seen, turn: float) -> float | None:
    """Share of the places (radius, height) that differ from what the same line saw ``turn`` rad of stated angle before.

    Only places that stand out from the commonest height, now or then: a table is alike from everywhere.
    """
    span = float(np.ptp(seen.s))
    step = _pitch(seen.s)
    if turn > span - 3.0 * step:
        return None
    frames = np.unique(seen.s)
    order = np.lexsort((seen.s, seen.line))
    line, s = seen.line[order], seen.s[order]
    width = 4.0 * span + 8.0 * turn
    key = line * width + (s - frames[0])  # ascending
    wanted = key + turn
    after = np.searchsorted(key, wanted).clip(1, len(key) - 1)
    before = after - 1
    gap = key[after] - key[before]
    inside = (line[after] == line) & (line[before] == line) & (gap < 2.5 * step) & (wanted <= key[after])
    if int(inside.sum()) < _LEAST_PAIRS:
        return None
    part = np.where(gap > 0.0, (wanted - key[before]) / np.where(gap > 0.0, gap, 1.0), 0.0)
    off = []
    for values in (seen.radius[order], seen.height[order]):
        then = values[before] + part * (values[after] - values[before])
        off.append((then - values)[inside])
    least = max(_NOISES * seen.sigma, _PART * float(np.percentile(seen.radius, 95)))
    height = seen.height[order]
    level = _level(height, least)
    stands = inside & ((np.abs(height - level) > least) | (np.abs(height[after] - level) > least))
    if int(stands.sum()) < _LEAST_PAIRS:
        return None
    return float((np.hypot(*off)[stands[inside]] > least).mean())


def _pitch(s: Array) -> float:
    """Median step between the positions, rad."""
    steps = np.diff(np.unique(s))
    return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else _TURN


def _base(seen: _Seen) -> str:
    """Whether a flat base comes out flatter by other angles than by those stated."""
    size = float(np.percentile(seen.radius, 95))
    level = _level(seen.height, 0.5 * _BASE * size)
    near = np.abs(seen.height - level) < _BASE * size
    if int(near.sum()) < _LEAST_PAIRS or np.ptp(seen.s[near]) < 0.25 * _TURN:
        return ""
    stated = _flatness(seen, near, 1.0)
    if stated < 5.0 * seen.sigma:
        return ""
    every = sorted({*FACTORS, *(-f for f in FACTORS)} - {1.0})
    others = {factor: _flatness(seen, near, factor) for factor in every}
    best = min(others, key=lambda factor: others[factor])
    if others[best] * _BETTER > stated:
        return ""
    ways = (
        "turned the other way" if best == -1.0 else f"turned {'the other way, ' * (best < 0)}{_times(abs(best))} as far"
    )
    return (
        f"its base wobbles by {stated:.2g} mm (median) by the stated angles, and by {others[best]:.2g} mm if the table {ways}: "
        "check the sign and the size of step, and moves"
    )


def _level(height: Array, width: float) -> float:
    """Commonest height, mm, in bins of ``width``."""
    bins = np.round(height / width).astype(np.int64)
    values, counts = np.unique(bins, return_counts=True)
    return float(np.median(height[bins == values[np.argmax(counts)]]))


def _flatness(seen: _Seen, near: Bools, factor: float) -> float:
    """Median distance mm of the base's points from their plane, if the angles were ``factor`` times those stated."""
    azimuth = seen.azimuth[near] - factor * seen.s[near]
    x, y = seen.radius[near] * np.cos(azimuth), seen.radius[near] * np.sin(azimuth)
    terms = np.stack([np.ones_like(x), x, y], axis=1)
    weight = np.ones_like(x)
    height = seen.height[near]
    left = height - np.median(height)
    for _ in range(8):  # Tukey's weights: what stands on the base is not part of it
        root = np.sqrt(weight)
        fit = np.linalg.lstsq(terms * root[:, None], height * root, rcond=None)[0]
        left = height - terms @ fit
        scale = max(1.4826 * float(np.median(np.abs(left))), 1e-6)
        weight = np.square(1.0 - np.minimum(np.square(left / (4.0 * scale)), 1.0))
    return float(np.median(np.abs(left)))


def _times(factor: float) -> str:
    """Name of a simple factor."""
    names = {
        2.0: "twice",
        0.5: "half",
        3.0: "three times",
        1 / 3: "a third",
        1.5: "one and a half times",
        4.0: "four times",
    }
    return names.get(
        factor, "two thirds" if abs(factor - 2 / 3) < 1e-9 else "a quarter" if factor == 0.25 else f"{factor:g} times"
    )
