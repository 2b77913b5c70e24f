"""Where camera and laser reach past the objects of the design, and which of their surface stays out of sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Bools, Rays
from scope.design.prediction import WorkingMap, onto_sheet
from scope.simulation import VirtualRig, exact_rays, project

_MARGIN = 0.5  # mm before the point, within which a surface is the point's own
_GRID = 120  # places along the longer side of the map
_ABOVE = 1e4  # mm, from where the surface is looked for


@dataclass(frozen=True, slots=True, eq=False)
class HiddenMap:
    """The surface that objects turn towards -z, as a linear motion carries it through the sheet of light.

    ``state``: 0 seen, 1 the laser does not reach it, 2 the camera does not see it, 3 neither, 4 it never comes onto the sheet within
    the image, the volume and the frames of the motion; -1 nothing is there.
    """

    across: Array  # (A,) mm, x in C with the object at position 0
    down: Array  # (D,) mm, y likewise
    state: np.typing.NDArray[np.int8]  # (D, A)

    @property
    def shares(self) -> dict[str, float]:
        """Parts of one of the surface, seen along z."""
        names = ("seen", "laser_hidden", "camera_hidden", "both_hidden", "outside")
        total = max(int((self.state >= 0).sum()), 1)
        return {name: float((self.state == k).sum()) / total for k, name in enumerate(names)}


def unobstructed(rig: VirtualRig, points: Array, travel: Array) -> tuple[Bools, Bools]:
    """Whether nothing stands between camera and points, and between laser and points (N, 3) mm in C, on the sheet.

    ``travel`` (N,) is the position of a linear motion at which each is on the sheet; NaN: the objects stand still.
    """
    count = len(points)
    if not rig.scene.parts:
        return np.ones(count, dtype=bool), np.ones(count, dtype=bool)
    shift = _shift(rig, travel)
    pixels = project(rig.camera, points)
    light, _ = rig.laser.reach(points)
    reached = []
    for rays in (exact_rays(rig.camera, pixels), light):
        away = np.einsum("ni,ni->n", points - rays.origin, rays.direction)
        # the objects stay and the ray moves back: one scene for all positions
        back = Rays(np.asarray(rays.origin - shift), np.asarray(rays.direction))
        with np.errstate(invalid="ignore"):
            reached.append(np.isfinite(away) & (rig.scene.cast(back).distance >= away - _MARGIN))
    return reached[0], reached[1]


def hidden_map(rig: VirtualRig, area: WorkingMap) -> HiddenMap | None:
    """Map of what is out of sight of the design's objects; None without objects that a linear motion carries.

    What is looked for from -z: walls that stand along z are lines of the map.
    """
    motion = rig.design.motion
    if motion is None or motion.kind != "linear" or not motion.step or not rig.scene.parts:
        return None
    reach = motion.start + motion.step * np.array([0.0, motion.frames - 1])
    sheet = area.prediction.points[area.prediction.inside]
    swept = np.concatenate([sheet - _shift(rig, np.full(len(sheet), at)) for at in reach])[:, :2]
    low, high = swept.min(axis=0), swept.max(axis=0)
    surface = _surface(rig, low, high, 40)
    found = np.argwhere(np.isfinite(surface[:, :, 2]))
    if not len(found):
        return None
    places = surface[tuple(found.T)][:, :2]  # a closer look at where the objects are
    room = np.maximum((high - low) / 40, 1e-3)
    surface = _surface(
        rig, np.maximum(places.min(axis=0) - room, low), np.minimum(places.max(axis=0) + room, high), _GRID
    )
    flat = surface.reshape(-1, 3)
    there = np.isfinite(flat[:, 2])
    on_sheet, travel = onto_sheet(rig, flat[there])
    camera, laser = unobstructed(rig, on_sheet, travel)
    with np.errstate(invalid="ignore"):
        within = (travel >= reach.min() - 1e-9) & (travel <= reach.max() + 1e-9) & area.holds(rig, on_sheet)
    state = np.full(len(flat), -1, dtype=np.int8)
    state[there] = np.where(within, 1 * ~laser + 2 * ~camera, 4)
    shape = surface.shape[:2]
    return HiddenMap(surface[0, :, 0], surface[:, 0, 1], state.reshape(shape))


def _surface(rig: VirtualRig, low: Array, high: Array, longest: int) -> Array:
    """Points (D, A, 3) of the objects at position 0 that face -z, on a grid; z is NaN where there is none."""
    sides = np.maximum(high - low, 1e-6)
    count = np.maximum(np.ceil(longest * sides / sides.max()).astype(int), 2)
    x, y = np.meshgrid(*(np.linspace(low[k], high[k], count[k]) for k in (0, 1)))
    start = np.stack([x.ravel(), y.ravel(), np.full(x.size, -_ABOVE)], axis=1)
    hits = rig.scene.cast(Rays(start, np.broadcast_to([0.0, 0.0, 1.0], start.shape)))
    return np.stack([x, y, hits.points[:, 2].reshape(x.shape)], axis=-1)


def _shift(rig: VirtualRig, travel: Array) -> Array:
    """By how much (N, 3) mm the objects stand elsewhere than at position 0."""
    motion = rig.design.motion
    if motion is None or motion.kind != "linear" or motion.direction is None:
        return np.zeros((len(travel), 3))
    direction = np.array(motion.direction) / np.linalg.norm(motion.direction)
    way = 1.0 if motion.moves == "object" else -1.0
    return np.asarray(np.nan_to_num(travel)[:, None] * way * direction)
