"""A region of a cloud to a height map on the scan's own lattice."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints, fit_plane
from scope.cloud import Region, ScanCloud, lattice_index, lattice_lines, refuse_sheet
from scope.errors import MeasurementError
from scope.heightmap.heights import HeightMap

LEAST_POINTS = 1000
DEEPEST = 10.0  # mm rms: beyond, it is no roughness but a shape or a wrong unit
_FINEST_PITCH = 1e-3  # mm: finer than a laser scanner samples
_EMPTIEST = 400.0  # cells of a grid for each point, beyond which points are scattered and no surface
_LARGEST_SKEW = 0.17  # |cos| between rows and columns: beyond 10 degrees the lattice is no rectangle


def patch_heights(cloud: ScanCloud, region: Region | None = None) -> HeightMap:
    """Heights of a region above its total least squares plane, on the lattice of frames and image lines.

    Nothing is interpolated: each height is a measured point's distance from the plane, and a pixel without a point is
    a gap. The pitch is the mean distance of neighbours along the plane; that rows and columns are straight and evenly
    spaced to within a few percent is taken as given (unevenness of 5 % moves slopes by 0.2 %). A cloud without scan
    order, or whose lattice is skewed by more than 10 degrees, is gridded by linear interpolation instead, and a note
    says what that did to Sq.

    Parameters
    ----------
    cloud : ScanCloud
        In scan order. Of several lasers the one with most points in the region is used, which a note says.
    region : Region, optional
        Part of the cloud; all of it unless told.

    Returns
    -------
    HeightMap
        Rows are frames, columns image lines; positive heights point to the sensor, or to +z where the cloud does not
        know its sensor. ``sigma`` is that of the points times the cosine between sighting ray and normal.

    Raises
    ------
    MeasurementError
        An empty region, fewer than 1,000 points, a single profile, or points on a line.
    """
    part, notes = _selected(cloud, region)
    notes = (*cloud.notes, *notes)
    index = _thinned(lattice_index(part, int(part.laser[0])))
    if max(index.shape) >= 2 and min(index.shape) < 2:
        raise MeasurementError(
            f"the region holds a single profile of {len(part)} points; an areal measurement needs a scan of many "
            "frames: choose a wider region"
        )
    refuse_sheet(cloud)
    _refuse_depth(part)
    frame = _Levelled.of(part)
    sigma = _height_sigma(part, frame)
    if part.sensors is None:
        notes = (*notes, "the cloud does not tell where its sensor was: heights count towards +z")
    if not np.isfinite(sigma).any():
        notes = (*notes, "the points carry no sigma: their noise is not predicted")
    if min(index.shape) < 2:
        return _gridded(part, frame, (*notes, "warning: the cloud has no scan order (frame and pixel)"))
    steps, skew = _steps(frame.local, index)
    if skew > _LARGEST_SKEW:
        why = f"warning: rows and columns of the scan meet at {np.degrees(np.arccos(skew)):.0f} degrees"
        return _gridded(part, frame, (*notes, why))
    if max(steps) < _FINEST_PITCH:
        notes = (
            *notes,
            f"warning: a pitch of {max(steps):.3g} mm is finer than a laser scanner's: are the data in mm?",
        )
    found = index >= 0
    z, spread, points = (np.full((*index.shape, *tail), np.nan) for tail in ((), (), (3,)))
    z[found], spread[found], points[found] = (
        frame.local[index[found], 2],
        sigma[index[found]],
        part.points[index[found]],
    )
    return HeightMap(
        z=z,
        pitch=steps,
        sigma=spread,
        points=points,
        origin=(int(part.frame.min()), int(lattice_lines(part).min())),
        stripe_width=_of_laser(part.stripe_width, part, math.nan),
        stripe_corrected=_of_laser(part.stripe_corrected, part, 0.0),
        form="plane",
        notes=notes,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Levelled:
    """Points in the frame of their total least squares plane."""

    local: Array  # (N, 3) mm, two coordinates in the plane, then the height
    axes: Array  # (3, 3), its columns are the two directions in the plane and the normal

    @classmethod
    def of(cls, part: ScanCloud) -> _Levelled:
        centre = part.points.mean(axis=0)
        try:
            normal = fit_plane(part.points).normal
        except ValueError as error:
            raise MeasurementError(
                f"the {len(part)} points of the region lie on one line; choose a region that is a surface"
            ) from error
        up = np.array([0.0, 0.0, 1.0])
        if part.sensors is not None:
            up = np.nanmean(part.sensors.centre, axis=0) - centre
        normal = normal if normal @ up >= 0.0 else -normal
        first = np.eye(3)[int(np.argmin(np.abs(normal)))]
        first = first - (first @ normal) * normal
        first /= np.linalg.norm(first)
        axes = np.stack([first, np.cross(normal, first), normal], axis=1)
        return cls((part.points - centre) @ axes, axes)


def _selected(cloud: ScanCloud, region: Region | None) -> tuple[ScanCloud, tuple[str, ...]]:
    inside = np.ones(len(cloud), dtype=np.bool_) if region is None else region.contains(cloud.points)
    count = int(inside.sum())
    if count == 0:
        span = (
            "no points"
            if len(cloud) == 0
            else ", ".join(
                f"{name} {low:.1f} to {high:.1f}"
                for name, low, high in zip("xyz", cloud.points.min(axis=0), cloud.points.max(axis=0), strict=True)
            )
        )
        raise MeasurementError(f"the region is empty: the cloud spans {span} mm; move the region onto it")
    lasers, counts = np.unique(cloud.laser[inside], return_counts=True)
    best = lasers[int(np.argmax(counts))]
    notes: tuple[str, ...] = ()
    if len(lasers) > 1:
        name = cloud.laser_names[best] if best < len(cloud.laser_names) else str(best)
        notes = (f"only the points of laser {name!r} are used: {counts.max()} of {count}",)
        inside &= cloud.laser == best
        count = int(counts.max())
    if count < LEAST_POINTS:
        raise MeasurementError(
            f"the region holds {count} points; roughness needs {LEAST_POINTS} or more: choose a larger region or "
            "scan with smaller steps"
        )
    return cloud.select(inside), notes


def _of_laser(values: tuple[float, ...], part: ScanCloud, unknown: float) -> float:
    """What a cloud tells of the laser of a part."""
    laser = int(part.laser[0])
    return values[laser] if laser < len(values) else unknown


def _refuse_depth(part: ScanCloud) -> None:
    """``MeasurementError`` where depth scatters, from frame to frame and line to line, by what no roughness does.

    Seen on the scan's own lattice, since a plane through points that are deeper than wide turns on end and hides it.
    """
    lines = lattice_lines(part)
    if part.sensors is None or (lines < 0).any():
        return
    sight = part.points.mean(axis=0) - np.nanmean(part.sensors.centre, axis=0)
    length = float(np.linalg.norm(sight))
    if not length > 0.0:
        return
    depth = (part.points - part.points.mean(axis=0)) @ (sight / length)
    u, v = (values - values.mean() for values in (part.frame.astype(np.float64), lines.astype(np.float64)))
    u, v = (values / max(float(np.abs(values).max()), 1.0) for values in (u, v))
    design = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1)
    spread = float(np.std(depth - design @ np.linalg.lstsq(design, depth, rcond=None)[0]))
    if spread > DEEPEST:
        raise MeasurementError(
            f"the points scatter by {spread:.3g} mm rms along the sight, which is no roughness (limit {DEEPEST:g} mm): "
            "check that the data are in mm and that the region is one surface"
        )


def _thinned(index: Ints) -> Ints:
    """Index without the rows and columns that are empty at a fixed rhythm (every other frame is another laser's)."""
    for axis in (0, 1):
        used = np.flatnonzero((index >= 0).any(axis=1 - axis))
        if len(used) > 1:
            rhythm = int(np.gcd.reduce(np.diff(used)))
            index = index[used[0] :: rhythm] if axis == 0 else index[:, used[0] :: rhythm]
    return index


def _steps(local: Array, index: Ints) -> tuple[tuple[float, float], float]:
    """Pitch (down, along) mm of a lattice in its plane, and |cos| of the angle between the two directions."""
    directions = []
    for axis in (0, 1):
        a, b = (index[:-1], index[1:]) if axis == 0 else (index[:, :-1], index[:, 1:])
        pairs = (a >= 0) & (b >= 0)
        if not pairs.any():
            raise MeasurementError(
                "no two points of the region are neighbours on the scan's lattice; too much of the surface is missing"
            )
        directions.append((local[b[pairs], :2] - local[a[pairs], :2]).mean(axis=0))
    lengths = [float(np.linalg.norm(d)) for d in directions]
    if min(lengths) == 0.0:
        raise MeasurementError("neighbouring frames fall on one another: the scan did not move; check its motion")
    return (lengths[0], lengths[1]), abs(float(directions[0] @ directions[1])) / (lengths[0] * lengths[1])


def _height_sigma(part: ScanCloud, frame: _Levelled) -> Array:
    """Noise of each height (N,) mm: sigma along the sighting ray, as far as the ray is along the normal."""
    sigma = part.sigma.astype(np.float64)
    if part.sensors is None:
        return sigma
    rows = {(int(f), int(k)): i for i, (f, k) in enumerate(zip(part.sensors.frame, part.sensors.laser, strict=True))}
    frames, inverse = np.unique(part.frame, return_inverse=True)
    laser = int(part.laser[0])
    centres = np.array(
        [part.sensors.centre[rows[int(f), laser]] if (int(f), laser) in rows else np.full(3, np.nan) for f in frames]
    )
    ray = part.points - centres[inverse]
    length = np.linalg.norm(ray, axis=1)
    cosine = np.abs(ray @ frame.axes[:, 2]) / np.where(length > 0.0, length, 1.0)
    return sigma * np.where(np.isfinite(cosine), cosine, 1.0)


def _gridded(part: ScanCloud, frame: _Levelled, notes: tuple[str, ...]) -> HeightMap:
    """Linear interpolation on a square grid of the points' mean spacing; holes wider than two spacings stay gaps."""
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import ConvexHull, cKDTree

    flat = frame.local[:, :2]
    pitch = float(np.sqrt(ConvexHull(flat).volume / len(flat)))
    low, high = flat.min(axis=0), flat.max(axis=0)
    counts = np.maximum(((high - low) / pitch).astype(int), 1)
    if float(np.prod((high - low) / pitch)) > _EMPTIEST * len(flat):
        raise MeasurementError(
            f"{len(flat)} points lie scattered over {high[0] - low[0]:.3g} x {high[1] - low[1]:.3g} mm, far from an even cover; "
            "choose a region of the surface"
        )
    along, down = (low[k] + pitch * (np.arange(counts[k]) + 0.5) for k in (0, 1))
    x, y = np.meshgrid(along, down)
    nodes = np.stack([x.ravel(), y.ravel()], axis=1)
    z = np.asarray(LinearNDInterpolator(flat, frame.local[:, 2])(nodes))
    z[cKDTree(flat).query(nodes)[0] > 2.0 * pitch] = np.nan
    change = 100.0 * (float(np.nanstd(z)) / float(frame.local[:, 2].std()) - 1.0)
    told = (
        f"{notes[-1]}: gridded by linear interpolation at {pitch:.3g} mm, which changed Sq by {change:+.2f} % before "
        "form removal; slopes come out lower and noise is not predicted"
    )
    return HeightMap(
        z=z.reshape(x.shape),
        pitch=(pitch, pitch),
        points=_on_plane(part, frame, x, y, z),
        in_order=False,
        form="plane",
        notes=(*notes[:-1], told),
    )


def _on_plane(part: ScanCloud, frame: _Levelled, x: Array, y: Array, z: Array) -> Array:
    """Cloud-frame positions (rows, columns, 3) mm of grid nodes."""
    local = np.stack([x, y, z.reshape(x.shape)], axis=2)
    return np.asarray(local @ frame.axes.T + part.points.mean(axis=0))
