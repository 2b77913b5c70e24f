"""Points in scan order, with what is known of each: the columns that files, filters and the lattice work on."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools, Pose, rotation_from_quaternion
from calibration.notebook import Picture, Shown, Summary, number, scatter


@dataclass(frozen=True, slots=True, eq=False)
class Sensors:
    """Where the camera and the laser were, one row a frame and laser, in the cloud frame."""

    frame: NDArray[np.int32]  # (M,)
    laser: NDArray[np.uint8]  # (M,)
    centre: Array  # (M, 3) mm, the point nearest to all sighting rays
    rotation: Array  # (M, 4) quaternion w x y z of cloud_from_C
    laser_origin: Array  # (M, 3) mm, NaN where unknown

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True, eq=False)
class Systematic:
    """What errors of the calibration do to a point, by its pixel: on a lattice of pixels of each laser's sheet.

    K independent errors, each of one standard deviation, move the points of a scan together; between the nodes it is linear. What
    moves the whole cloud with the stage that was found with the camera is left out.
    """

    laser: NDArray[np.uint8]  # (G,) index into laser_names; the nodes of a laser row by row of v
    pixels: Array  # (G, 2) px (u, v)
    moves: Array  # (G, K, 3) mm, in C
    local: Array  # (G,) mm along the ray, one sigma: what the sheet's shape leaves unexplained from place to place

    def at(self, laser: NDArray[np.uint8], pixels: Array) -> tuple[Array, Array]:
        """Movements (N, K, 3) mm in C of points of these lasers (N,) at pixels (N, 2), and their local sigma (N,) mm."""
        moves, local = np.zeros((len(pixels), *self.moves.shape[1:])), np.zeros(len(pixels))
        for k in np.unique(laser):
            rows, nodes = np.flatnonzero(laser == k), np.flatnonzero(self.laser == k)
            if not len(nodes):
                moves[rows], local[rows] = np.nan, np.nan
                continue
            u, v = np.unique(self.pixels[nodes, 0]), np.unique(self.pixels[nodes, 1])
            i, a = _between(u, pixels[rows, 0])
            j, b = _between(v, pixels[rows, 1])
            for dj, di in ((0, 0), (0, 1), (1, 0), (1, 1)):
                weight = (b if dj else 1 - b) * (a if di else 1 - a)
                node = nodes[(j + dj) * len(u) + i + di]
                moves[rows] += weight[:, None, None] * self.moves[node]
                local[rows] += weight * self.local[node]
        return moves, local


def _between(nodes: Array, x: Array) -> tuple[NDArray[np.int64], Array]:
    """Node (N,) below each of ``x``, and how far (N,) it lies on the way to the next; beyond the ends the ends count."""
    below = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    return below, np.clip((x - nodes[below]) / (nodes[below + 1] - nodes[below]), 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Columns(Shown):
    """What a `ScanCloud` holds: N ranged points of one scan, in scan order, by frame, then along the stripe.

    The frame is that of the calibration (C) with the object put back to position 0. ``sigma`` is independent from
    point to point and averages out; ``sigma_cal`` comes from the calibration, is shared, and does not.
    """

    points: Array  # (N, 3) mm, finite
    intensity: NDArray[np.float32]  # (N,) peak of the stripe, grey levels of the image
    sigma: NDArray[np.float32]  # (N,) mm along the sighting ray, one standard deviation
    sigma_cal: NDArray[np.float32]  # (N,) mm along the sighting ray, one standard deviation
    pixels: NDArray[np.float32]  # (N, 2) px (u, v); the coordinate along the stripe is whole
    frame: NDArray[np.int32]  # (N,)
    laser: NDArray[np.uint8]  # (N,) index into laser_names
    sensors: Sensors | None = None  # None where the file tells nothing
    normals: Array | None = None  # (N, 3) unit, towards the camera
    laser_names: tuple[str, ...] = ("laser",)
    rig_sha256: str = ""
    verified: bool = False  # the calibration passed its verification
    complete: bool = True  # no frame is missing
    stripe_width: tuple[float, ...] = ()  # mm, one sigma of each laser's stripe on the surface; empty: not known
    stripe_corrected: tuple[float, ...] = ()  # share (0 to 1) of what that width does to heights that ranging took off
    notes: tuple[str, ...] = ()  # what reading its file left out or joined
    origin: tuple[str, ...] = ()  # "what: value": rig, limits, when and by whom the scan was made, of which files
    camera_centre: Array = field(default_factory=lambda: np.full(3, np.nan))  # (3,) mm, in C
    systematic: Systematic | None = None  # None where the file tells nothing; then `sigma_cal` is all that is known

    def __len__(self) -> int:
        return len(self.points)

    def summary(self) -> Summary:
        """Points, frames, extent and noise."""
        if len(self) == 0:
            return Summary(f"{type(self).__name__}: no points")
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        known = self.sigma[np.isfinite(self.sigma)]
        figures = [
            ("frames", f"{len(np.unique(self.frame)):,}"),
            ("extent", " x ".join(f"{x:.4g}" for x in high - low) + " mm"),
            ("sigma", number(float(np.median(known)), "mm") if len(known) else "not known"),
        ]
        if self.rig_sha256:
            figures.append(("rig", f"{self.rig_sha256[:8]}, {'verified' if self.verified else 'not verified'}"))
        if not self.complete:
            figures.append(("complete", "no, frames are missing"))
        return Summary(f"{type(self).__name__}: {len(self):,} points", tuple(figures))

    def picture(self) -> tuple[Picture | None, str]:
        """The points seen along z, coloured by z."""
        x, y, z = self.points.T
        return scatter(x, y, z), "x to the right, y down, coloured by z"

    @classmethod
    def from_points(cls, points: Array) -> Self:
        """Bare points (N, 3) mm, of which nothing else is known: NaN sigma, frame 0, no sensors.

        Rows that are not finite are refused with ``ValueError``: a cloud holds ranged points only.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError("points must be (N, 3) and finite")
        n = len(points)
        unknown = np.full(n, np.nan, dtype=np.float32)
        return cls(
            points=points,
            intensity=unknown,
            sigma=unknown,
            sigma_cal=unknown,
            pixels=np.full((n, 2), np.nan, dtype=np.float32),
            frame=np.zeros(n, dtype=np.int32),
            laser=np.zeros(n, dtype=np.uint8),
        )

    def select(self, keep: Bools | NDArray[np.intp]) -> Self:
        """The points of a mask (N,) or of indices, still in the order given."""
        return replace(
            self,
            points=self.points[keep],
            intensity=self.intensity[keep],
            sigma=self.sigma[keep],
            sigma_cal=self.sigma_cal[keep],
            pixels=self.pixels[keep],
            frame=self.frame[keep],
            laser=self.laser[keep],
            normals=None if self.normals is None else self.normals[keep],
        )

    def shared_moves(self) -> tuple[Array, Array] | None:
        """How K errors of the calibration move the points together (N, 3, K) mm, and what is local (N,) mm along the ray.

        In the cloud frame, each error one standard deviation, but for motions of the whole cloud that follow the stage, which change
        no size. None where the cloud does not know.
        """
        if self.systematic is None or self.sensors is None or not np.isfinite(self.pixels).all():
            return None
        moves, local = self.systematic.at(self.laser, self.pixels.astype(np.float64))
        frames, first = np.unique(self.sensors.frame, return_index=True)
        place = np.clip(np.searchsorted(frames, self.frame), 0, len(frames) - 1)
        if not len(frames) or not np.isfinite(moves).all() or (frames[place] != self.frame).any():
            return None
        turns = np.stack([rotation_from_quaternion(q) for q in self.sensors.rotation[first]])[place]
        return np.einsum("nij,nkj->nik", turns, moves), local

    def cloud_from_camera(self, frame: int) -> Pose:
        """Pose cloud_from_C when ``frame`` was taken; ``ValueError`` where the cloud does not know it."""
        if self.sensors is None or not np.isfinite(self.camera_centre).all():
            raise ValueError("the cloud does not say where its sensor was")
        rows = np.flatnonzero(self.sensors.frame == frame)
        if len(rows) == 0:
            raise ValueError(f"the cloud has no frame {frame}")
        row = rows[0]
        rotation = rotation_from_quaternion(self.sensors.rotation[row])
        return Pose(rotation, self.sensors.centre[row] - rotation @ self.camera_centre)
