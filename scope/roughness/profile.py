"""Profile parameters along one direction of a map of heights (ISO 21920-2, with the settings of ISO 21920-3)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array
from scope.heightmap import ALPHA, gaussian

# Setting classes of ISO 21920-3: up to this mean element width (mm), this nesting index of the L-filter (mm).
_CLASSES: tuple[tuple[float, float], ...] = ((0.04, 0.08), (0.13, 0.25), (0.4, 0.8), (1.3, 2.5), (math.inf, 8.0))
SECTIONS = 5  # section lengths in an evaluation length (ISO 21920-3)
DISCRIMINATION = 0.10  # of Rz: a hill or dale lower than this is none (ISO 21920-2)
_FEWEST = 2  # section lengths that a cut-off found by itself must leave
_BRIDGE = 3  # samples: a lost height or two end no element
_MOST_PROFILES = 200  # whose elements are looked at one by one


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Roughness profiles of one direction, and what was done to get them."""

    z: Array  # (profiles, samples) mm, about the L-filter's mean line; NaN in gaps
    pitch: float  # mm along a profile
    cutoff: float  # mm, nesting index of the L-filter and section length
    sections: int  # whole sections in the evaluation length
    end_effect: float  # share of the heights within half a nesting index of an end or a gap

    @property
    def section(self) -> int:
        """Samples in a section."""
        return max(1, round(self.cutoff / self.pitch))


def roughness_profiles(z: Array, pitch: float, cutoff: float | None = None, *, noise: float = 0.0) -> Profiles:
    """Take the mean line off primary profiles (profiles, samples) mm sampled at ``pitch`` mm.

    The evaluation length is the middle of the map, in five sections of one nesting index, or as many as fit. Without a
    ``cutoff`` (mm) it is that of ISO 21920-3 for the mean width of the elements, or the longest of that table that fits
    twice where this is shorter: fewer sections than five cost certainty, a cut-off that is too short costs roughness.
    ``noise`` (mm rms, 0 for none) is smoothed away before the elements' width is taken.

    Raises
    ------
    ValueError
        A cut-off longer than the profiles or shorter than two samples.
    """
    length = z.shape[1] * pitch
    index = _default_cutoff(z, pitch, noise) if cutoff is None else cutoff
    if not 2.0 * pitch <= index <= length:
        raise ValueError(f"a cut-off of {index:g} mm does not fit profiles of {length:.3g} mm at {pitch:.3g} mm")
    smooth = gaussian(z, (1.0, pitch), (0.0, index))
    rough = z - smooth.z
    count = min(SECTIONS, int(length / index + 1e-9))
    samples = min(round(index / pitch) * count, z.shape[1])
    start = (z.shape[1] - samples) // 2
    part = np.s_[:, start : start + samples]
    known = np.isfinite(rough[part])
    affected = float((smooth.support[part][known] < 0.95).mean()) if known.any() else 0.0
    return Profiles(rough[part], pitch, index, count, affected)


def profile_parameters(profiles: Profiles) -> dict[str, Array]:
    """Parameters of each profile, (profiles,) each; NaN where a profile has too little.

    Ra Rq Rt Rsk Rku Rdq over the evaluation length, Rz as the mean over its sections, RSm and Rc as means over the
    profile elements, each a hill and a dale that leave the mean line by more than 10 % of Rz. A profile
    of which half is missing gives nothing.
    """
    z = profiles.z
    known = np.isfinite(z)
    enough = known.sum(axis=1) >= max(10, z.shape[1] // 2)
    count = np.maximum(known.sum(axis=1), 1)
    centred = np.where(known, z, 0.0)
    centred = np.where(known, centred - (centred.sum(axis=1) / count)[:, None], 0.0)
    square = centred * centred
    variance = square.sum(axis=1) / count
    safe = np.where(variance > 0.0, variance, np.nan)
    step = np.diff(z, axis=1) / profiles.pitch
    pairs = np.isfinite(step)
    result = {
        "Ra": np.abs(centred).sum(axis=1) / count,
        "Rq": np.sqrt(variance),
        **profile_extremes(profiles),
        "Rsk": (square * centred).sum(axis=1) / count / safe**1.5,
        "Rku": (square * square).sum(axis=1) / count / safe**2,
        "Rdq": np.sqrt(np.square(np.where(pairs, step, 0.0)).sum(axis=1) / np.maximum(pairs.sum(axis=1), 1)),
    }
    result = {name: np.where(enough, each, np.nan) for name, each in result.items()}
    return result | profile_elements(profiles)


def profile_elements(profiles: Profiles) -> dict[str, Array]:
    """RSm and Rc of each profile, (profiles,) mm each, as `profile_parameters` has them; of 200 profiles at most."""
    z, heights = profiles.z, profile_extremes(profiles)["Rz"]
    result = {"RSm": np.full(len(z), np.nan), "Rc": np.full(len(z), np.nan)}
    rows = np.flatnonzero(np.isfinite(heights))
    for row in rows[:: max(1, -(-len(rows) // _MOST_PROFILES))]:
        result["RSm"][row], result["Rc"][row] = elements(
            z[row] - np.nanmean(z[row]), profiles.pitch, DISCRIMINATION * heights[row]
        )
    return result


def profile_extremes(profiles: Profiles) -> dict[str, Array]:
    """Rz and Rt of each profile, (profiles,) mm each, as `profile_parameters` has them."""
    z = profiles.z
    known = np.isfinite(z)
    enough = known.sum(axis=1) >= max(10, z.shape[1] // 2)
    height = np.where(known, z, -np.inf).max(axis=1) - np.where(known, z, np.inf).min(axis=1)
    sections = _section_heights(z, profiles.section)
    return {"Rz": np.where(enough, sections, np.nan), "Rt": np.where(enough, height, np.nan)}


def elements(profile: Array, pitch: float, threshold: float) -> tuple[float, float]:
    """Mean width (mm) and mean height (mm) of the elements of a profile (N,) mm about its mean line: RSm and Rc.

    An element runs from one upward crossing of the mean line to the next; a hill or a dale that stays within
    ``threshold`` (mm) of the line is not one and does not end an element. Elements reach across gaps of up to three samples,
    which straight lines bridge, and no farther; NaN where there is none.
    """
    widths, heights = 0.0, 0.0
    count = 0
    for piece in _pieces(_bridged(profile)):
        crossings = _upward_crossings(piece, threshold)
        if len(crossings) < 2:
            continue
        starts = np.ceil(crossings).astype(np.int64)
        inside = piece[starts[0] : starts[-1]]
        places = starts[:-1] - starts[0]
        span = np.maximum.reduceat(inside, places) - np.minimum.reduceat(inside, places)
        widths += float(crossings[-1] - crossings[0]) * pitch
        heights += float(span.sum())
        count += len(crossings) - 1
    return (widths / count, heights / count) if count else (math.nan, math.nan)


def _upward_crossings(piece: Array, threshold: float) -> Array:
    """Places (fractions of samples) where a profile without gaps crosses zero from a true dale to a true hill."""
    beyond = np.flatnonzero(np.abs(piece) > threshold)
    if len(beyond) < 2:
        return np.zeros(0)
    rises = np.flatnonzero((piece[beyond[:-1]] < 0.0) & (piece[beyond[1:]] > 0.0))
    below = np.flatnonzero(piece <= 0.0)
    last = below[np.searchsorted(below, beyond[rises + 1]) - 1]
    return np.asarray(last + piece[last] / (piece[last] - piece[last + 1]))


def _bridged(profile: Array) -> Array:
    """Profile (N,) mm with a straight line over every gap of up to three samples."""
    known = np.flatnonzero(np.isfinite(profile))
    if len(known) in (0, len(profile)):
        return profile
    bridge = np.interp(np.arange(len(profile)), known, profile[known], left=np.nan, right=np.nan)
    before = np.searchsorted(known, np.arange(len(profile)), "right") - 1
    width = np.append(np.diff(known), 1)[np.maximum(before, 0)] - 1
    return np.where(width <= _BRIDGE, bridge, profile)


def _pieces(profile: Array) -> Iterator[Array]:
    """Stretches of a profile without gaps, of ten samples or more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isfinite(profile).astype(np.int8), [0]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start >= 10:
            yield profile[start:stop]


def _section_heights(z: Array, section: int) -> Array:
    """Mean over sections of highest minus lowest (profiles,) mm; sections with half of their heights missing are left out."""
    count = max(1, z.shape[1] // section)
    parts = z[:, : count * section].reshape(len(z), count, -1)
    known = np.isfinite(parts)
    height = np.where(known, parts, -np.inf).max(axis=2) - np.where(known, parts, np.inf).min(axis=2)
    good = known.sum(axis=2) >= max(2, parts.shape[2] // 2)
    total = np.where(good, height, 0.0).sum(axis=1)
    return np.asarray(np.divide(total, good.sum(axis=1), out=np.full(len(z), np.nan), where=good.any(axis=1)))


def _default_cutoff(z: Array, pitch: float, noise: float) -> float:
    length = float(z.shape[1] * pitch)
    fitting = [index for _, index in _CLASSES if 4.0 * pitch <= index <= length / _FEWEST]
    if not fitting:
        return max(4.0 * pitch, length / SECTIONS) if length >= 4.0 * pitch else length
    widths = []
    for profile in _denoised(z[:: max(1, len(z) // 50)], noise):
        if np.isfinite(profile).any():
            profile = profile - np.nanmean(profile)
            widths.append(elements(profile, pitch, DISCRIMINATION * float(np.nanmax(profile) - np.nanmin(profile)))[0])
    found = np.array(widths)[np.isfinite(widths)]
    if len(found) == 0:
        return fitting[-1]
    width = float(np.median(found))
    wanted = next(index for limit, index in _CLASSES if width <= limit)
    return min(max(wanted, fitting[0]), fitting[-1])


def _denoised(z: Array, noise: float) -> Array:
    """Profiles (N, samples) mm behind the shortest Gaussian that leaves white noise (mm rms) a hundredth of the variance.

    A smoothed wave keeps its width, which noise would cut to pieces.
    """
    smooth, index = z, 2.0
    left = noise**2
    while left > 0.01 * float(np.nanvar(smooth)) and index < z.shape[1] / 8.0:
        smooth = np.where(np.isfinite(z), gaussian(z, (1.0, 1.0), (0.0, index)).z, np.nan)
        left = noise**2 / (math.sqrt(2.0) * ALPHA * index)  # the integral of the squared weights
        index *= 1.5
    return smooth
