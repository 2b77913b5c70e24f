"""A calibration from images in memory, as if a calibration.toml had named them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array, Pose
from calibration.targets import Polarity, SpotGrid, Target
from ranging.background import Image
from scope.session.calibration_file import Along, CalibrationPlan, Channel, LaserPlan, PlanePlan
from scope.session.images import ImageInMemory
from scope.session.target_section import Plate

Images = Sequence[Image]
ByLaser = Images | Mapping[str, Images]
_PLACE = Path("CalibrationSession")  # stands where messages name the file


@dataclass(frozen=True, slots=True, eq=False)
class PlaneView:
    """The target in one place, seen one time or more, and the laser's stripe on it.

    Each image is (rows, columns) or (rows, columns, 3) of uint8 or uint16, as the camera gives it (blue, green, red).
    """

    images: Images  # repeats, one at least
    origin: Sequence[float] | Array | None = None  # (3,) mm, of the target's frame in C; None: held by hand
    rotation: Sequence[float] | Array = (0.0, 0.0, 0.0)  # (3,) degrees, rotation vector of the target in C
    laser: ByLaser = ()  # repeats with the laser on; by name where there are several lasers
    background: ByLaser = ()  # with the laser off
    name: str = ""  # empty: plane 1, plane 2, ...
    turned: Literal[0, 90, 180, 270] | None = None  # degrees by which a grid without fiducials stands turned


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationSession:
    """A target, the places where it was seen, and what must be reached: what calibration.toml says, from arrays."""

    target: Target
    planes: Sequence[PlaneView]
    accept: Mapping[str, float] = field(default_factory=dict)  # limits: ray_mm, laser_mm, repeat_px
    camera_id: str = ""
    along: Along = "auto"
    channel: Channel = "auto"
    plate: Plate = "auto"  # where the target's plane reaches beyond its marks


def plan_of(session: CalibrationSession) -> CalibrationPlan:
    """Plan of a session; ``ValueError`` with what is wanted for anything that is no image, place or limit."""
    if not session.planes:
        raise ValueError("planes is empty: give a PlaneView for each place of the target, two at least")
    unknown = set(session.accept) - {"ray_mm", "laser_mm", "repeat_px"}
    if unknown:
        raise ValueError(f"accept names {sorted(unknown)[0]!r}: the limits are ray_mm, laser_mm and repeat_px")
    if isinstance(session.target, SpotGrid):
        try:
            session.target.check_fiducials()
        except CalibrationError as error:
            raise ValueError(f"target: {error}") from error
    planes = tuple(_plane(view, view.name or f"plane {k}") for k, view in enumerate(session.planes, start=1))
    names = [plane.name for plane in planes]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two planes are called {name!r}; give each a name of its own")
    lasers = tuple(
        LaserPlan(name, session.along, session.channel, None)
        for name in dict.fromkeys(name for plane in planes for name in plane.lasers)
    )
    polarity: Polarity = getattr(session.target, "polarity", "light")  # boards have none
    return CalibrationPlan(
        _PLACE, session.camera_id, session.target, polarity, dict(session.accept), lasers, planes, (), session.plate
    )


def _plane(view: PlaneView, name: str) -> PlanePlan:
    if len(view.images) == 0:
        raise ValueError(f"{name}: images is empty; give one image of the target at least")
    pose = None
    if view.origin is not None:
        pose = Pose.from_rotation_vector(
            np.deg2rad(_vector(view.rotation, f"{name}: rotation", "degrees")),
            _vector(view.origin, f"{name}: origin", "mm"),
        )
    elif np.any(view.rotation):
        raise ValueError(f"{name}: has a rotation and no origin; give both (jig) or neither (held by hand)")
    return PlanePlan(
        name, _named(view.images, name), pose, _by_laser(view.laser, f"{name}, laser"),
        _by_laser(view.background, f"{name}, laser off"), None, view.turned,
    )  # fmt: skip


def _vector(value: Sequence[float] | Array, name: str, unit: str) -> Array:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be three finite numbers, {unit}; it has the shape {vector.shape}")
    return vector


def _by_laser(value: ByLaser, name: str) -> dict[str, tuple[ImageInMemory, ...]]:
    groups = value if isinstance(value, Mapping) else {"laser": value}
    return {laser: _named(images, f"{name} {laser}") for laser, images in groups.items() if len(images)}


def _named(images: Images, name: str) -> tuple[ImageInMemory, ...]:
    return tuple(ImageInMemory(f"{name}, image {k}", image) for k, image in enumerate(images, start=1))
