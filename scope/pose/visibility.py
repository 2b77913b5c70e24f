"""What camera and laser could see of a part: which frame lit a place, from where it was seen, what stood in the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.geometry import Array, Bools, Ints, Plane, Pose, fit_plane, rotation_from_quaternion
from scope.cloud import ScanCloud
from scope.model import Scanned, Surface, hidden
from scope.refinement import UNKNOWN_WIDTH, Seen, Stripe, motions_of

LEAST_COSINE = 0.3  # surface at a greater slant to camera or laser is not counted on


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """A scan's geometry, made once for all candidates."""

    camera: Array  # (M, 3) mm, one row a frame used, cloud frame
    laser: Array  # (M, 3) mm, NaN where unknown
    camera_from_cloud: tuple[Pose, ...]  # M, up to the camera's own frame
    sheet: Plane | None  # the laser's sheet in the frame that moves with the camera; None where it cannot be found
    window: tuple[Array, Array] | None  # least and greatest direction (x/z, y/z) at which anything was seen
    tree: Any  # scipy cKDTree of all points
    reach: float  # mm, how near a point must lie for a place to count as covered
    obstacles: Array  # (O, 3) mm, points that are not the part's
    voxel: float  # mm
    row_of_point: Ints  # (N,) row of camera and laser for each point of the cloud

    def moments(self, points: Array) -> tuple[Array, Array, Bools]:
        """Camera (N, 3), laser (N, 3) at the moment each point was lit, and whether it was lit and in view at all."""
        if self.sheet is None:
            near = self.tree.query(points)[1]
            row = self.row_of_point[near]
            return self.camera[row], self.laser[row], np.ones(len(points), dtype=np.bool_)
        side = np.stack([self.sheet.distance(q.apply(points)) for q in self.camera_from_cloud])  # (M, N)
        crossed = (side[:-1] <= 0) != (side[1:] <= 0)
        lit = crossed.any(axis=0)
        first = np.argmax(crossed, axis=0)
        columns = np.arange(len(points))
        a, b = side[first, columns], side[first + 1, columns]
        part = np.divide(a, a - b, out=np.zeros_like(a), where=a != b)[:, None]
        camera = self.camera[first] * (1 - part) + self.camera[first + 1] * part
        laser = self.laser[first] * (1 - part) + self.laser[first + 1] * part
        if self.window is not None:
            rotation = np.stack([q.rotation for q in self.camera_from_cloud])[first]
            local = np.einsum("nij,nj->ni", rotation, points - camera)
            with np.errstate(divide="ignore", invalid="ignore"):
                direction = local[:, :2] / local[:, 2:]
            lit &= ((direction >= self.window[0]) & (direction <= self.window[1])).all(axis=1)
        return camera, laser, lit

    def expected(self, surface: Surface, pose: Pose, samples: Array, normals: Array, foreign: Array) -> Bools:
        """Samples (S,) of the model at ``pose`` that should have been ranged.

        Facing camera and laser, not hidden from either by the model itself or by things of the scan that are not the
        part: ``foreign`` points (K, 3) of this piece and all others.
        """
        at, out = pose.apply(samples), normals @ pose.rotation.T
        camera, laser, wanted = self.moments(at)
        inverse = pose.inverse
        blocks = np.concatenate([self.obstacles, foreign])
        for eye in (camera, laser):
            if not np.isfinite(eye).all():
                continue
            way = eye - at
            length = np.linalg.norm(way, axis=1, keepdims=True)
            way /= length
            wanted &= (way * out).sum(axis=1) > LEAST_COSINE
            rows = np.flatnonzero(wanted)
            start = inverse.apply(at[rows] + 0.3 * self.voxel * out[rows])
            hit = surface.first_hit(start, way[rows] @ pose.rotation)
            wanted[rows] = np.isinf(hit)
            rows = np.flatnonzero(wanted)
            if len(blocks) and len(rows):
                wanted[rows] = ~self._hidden(at[rows], eye[rows], blocks)
        return wanted

    def uncovered(self, surface: Surface, pose: Pose, samples: Array, normals: Array) -> float:
        """Share of the samples expected at ``pose`` that no point of the scan covers; 1 where none is expected."""
        wanted = self.expected(surface, pose, samples, normals, np.zeros((0, 3)))
        return 1.0 - float(self.covered(pose.apply(samples[wanted])).mean()) if wanted.any() else 1.0

    def covered(self, points: Array) -> Bools:
        """Whether places (N, 3) have a point of the scan nearby."""
        return np.asarray(np.isfinite(self.tree.query(points, distance_upper_bound=self.reach)[0]))

    def _hidden(self, start: Array, end: Array, blocks: Array) -> Bools:
        """Whether segments pass an occupied voxel (or the neighbour of one), the first few voxels left out."""
        low = blocks.min(axis=0) - 2 * self.voxel
        shape = np.ceil((blocks.max(axis=0) - low) / self.voxel).astype(np.int64) + 3
        full = np.zeros(shape, dtype=np.bool_)
        index = ((blocks - low) / self.voxel).astype(np.int64)
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for dz in (-1, 0, 1):
                    full[index[:, 0] + dx, index[:, 1] + dy, index[:, 2] + dz] = True
        return hidden(full, low, self.voxel, start, end)


def viewpoints(cloud: ScanCloud, rows: Ints) -> tuple[Array | None, Array | None]:
    """Camera and laser (N, 3) of each point; None where the cloud does not tell."""
    sensors, found = cloud.sensors, _sensor_of(cloud, rows)
    if sensors is None or found is None or not np.isfinite(sensors.centre).all():
        return None, None
    laser = sensors.laser_origin[found]
    return sensors.centre[found], laser if np.isfinite(laser).all() else None


def _sensor_of(cloud: ScanCloud, rows: Ints) -> Ints | None:
    """Row of the sensors (N,) of each point; None where one has none."""
    sensors = cloud.sensors
    if sensors is None or len(sensors) == 0:
        return None
    key = sensors.frame.astype(np.int64) * 256 + sensors.laser
    order = np.argsort(key)
    wanted = cloud.frame[rows].astype(np.int64) * 256 + cloud.laser[rows]
    place = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
    found = order[place]
    return np.asarray(found) if (key[found] == wanted).all() else None


def stripe_of(cloud: ScanCloud, rows: Ints) -> Stripe | None:
    """The sheet of light and the camera's axis across the stripe at each point; None where the cloud does not tell them.

    The sheet is that of all points of a laser in the camera's own frame, the axis that of the image which it crosses more.
    """
    camera, laser = viewpoints(cloud, rows)
    found = _sensor_of(cloud, rows)
    if camera is None or found is None or cloud.sensors is None:
        return None
    turn = np.stack([rotation_from_quaternion(q) for q in cloud.sensors.rotation])
    sheet, across = np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
    for number in np.unique(cloud.laser[rows]):
        plane, _ = sheet_and_window(cloud, np.flatnonzero(cloud.sensors.laser == number))
        if plane is None:
            return None
        axis = np.eye(3)[int(np.argmax(np.abs(plane.normal[:2])))]
        mine = cloud.laser[rows] == number
        sheet[mine], across[mine] = turn[found[mine]] @ plane.normal, turn[found[mine]] @ axis
    known = [w for w in cloud.stripe_width if np.isfinite(w) and w > 0]
    return Stripe(sheet, across, laser, float(np.median(known)) if known else UNKNOWN_WIDTH)


def seen_of(cloud: ScanCloud, rows: Ints, sigma: Array) -> Seen:
    """The points of a part with all that the cloud knows of how they were seen; ``sigma`` (N,) mm without gaps."""
    points, (camera, laser), stripe = cloud.points[rows], viewpoints(cloud, rows), stripe_of(cloud, rows)
    line = None if stripe is None or camera is None else motions_of(points, camera, stripe.sheet, stripe.across)
    pixels = cloud.pixels[rows]
    whole = None
    if len(rows) and np.isfinite(pixels).all():
        rest = np.abs(pixels - np.round(pixels)).mean(axis=0)
        whole = np.round(pixels[:, int(np.argmin(rest))]).astype(np.int64)
    stated = bool(np.isfinite(cloud.sigma[rows]).any())
    width = UNKNOWN_WIDTH if stripe is None else stripe.width
    return Seen(Scanned(points, sigma, camera, line), stripe, laser, stated, whole, width)


def visibility_of(cloud: ScanCloud, others: Array, *, voxel: float, rows: int = 32) -> Visibility | None:
    """The geometry of a scan; None where the cloud does not say where its camera was.

    Parameters
    ----------
    cloud : ScanCloud
        The whole scan: the window of view follows from all of its points.
    others : (O, 3) mm
        Points of the scan that are not the part's and may hide it.
    voxel : float
        Side of the cubes, mm, in which obstacles are looked for.
    rows : int
        So many frames at most stand for the motion.
    """
    from scipy.spatial import cKDTree

    sensors = cloud.sensors
    if sensors is None or len(sensors) == 0 or not np.isfinite(sensors.centre).all():
        return None
    first = np.flatnonzero(sensors.laser == sensors.laser[0])
    first = first[np.argsort(sensors.frame[first])]
    chosen = first[np.unique(np.linspace(0, len(first) - 1, min(rows, len(first))).astype(np.int64))]
    poses = []
    for row in chosen:
        turned = rotation_from_quaternion(sensors.rotation[row]).T
        poses.append(Pose(turned, -turned @ sensors.centre[row]))
    tree = cKDTree(cloud.points)
    some = cloud.points[:: max(1, len(cloud) // 2000)]
    near = tree.query(some, k=2)[0][:, 1]
    reach = max(4.0 * float(np.median(near)), 0.8 * voxel)
    sheet, window = sheet_and_window(cloud, first)
    row_of_frame = np.zeros(int(max(sensors.frame.max(), cloud.frame.max())) + 1, dtype=np.int64)
    row_of_frame[:] = np.argmin(np.abs(sensors.frame[chosen][None, :] - np.arange(len(row_of_frame))[:, None]), axis=1)
    return Visibility(
        sensors.centre[chosen],
        sensors.laser_origin[chosen],
        tuple(poses),
        sheet if len(chosen) > 1 else None,
        window,
        tree,
        reach,
        others,
        voxel,
        row_of_frame[cloud.frame],
    )


def sheet_and_window(cloud: ScanCloud, rows: np.ndarray[Any, np.dtype[np.int64]]) -> tuple[Plane | None, Any]:
    """The plane on which all points of a laser lie in the camera's moving frame, and the bounds of their directions."""
    sensors = cloud.sensors
    if sensors is None:
        return None, None
    mine = np.flatnonzero(cloud.laser == sensors.laser[rows[0]])
    mine = mine[:: max(1, len(mine) // 8000)]
    order = {int(f): r for f, r in zip(sensors.frame[rows], rows, strict=True)}
    known = np.array([int(f) in order for f in cloud.frame[mine]])
    mine = mine[known]
    if len(mine) < 50:
        return None, None
    row = np.array([order[int(f)] for f in cloud.frame[mine]])
    turn = np.stack([rotation_from_quaternion(q).T for q in sensors.rotation])[row]
    local = np.einsum("nij,nj->ni", turn, cloud.points[mine] - sensors.centre[row])
    sheet = fit_plane(local)
    for _ in range(3):
        good = np.abs(sheet.distance(local)) < 3 * max(float(np.median(np.abs(sheet.distance(local)))), 1e-6) * 1.5
        sheet = fit_plane(local[good])
    spread = float(np.median(np.abs(sheet.distance(local))))
    if spread > 1.0:
        return None, None
    direction = local[:, :2] / local[:, 2:]
    return sheet, (direction.min(axis=0), direction.max(axis=0))
