"""Driver `simulated`: a virtual rig rendered live, so that everything can be tried without hardware."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array
from scope.cameras.camera import CameraInfo, Setting, Shot
from scope.session import CameraSettings
from scope.simulation import VirtualRig, read_design

_KEPT = 6  # rendered views held, so that what stands still is rendered once


@dataclass(frozen=True, slots=True)
class View:
    """What stands before a simulated camera."""

    plane: str = ""  # name of a target's place on the jig; empty: the object
    laser: bool = True
    moving: bool = True  # the object on its stage: frame after frame of the design's motion


class SimulatedCamera:
    """The camera of a rig-design.toml.

    Started anew it gives the frames that `scope simulate` writes of the same design with the seed 0, bit for bit, and then
    ends; with ``again`` the stage goes back and forth without end, as a live view wants it.

    Parameters
    ----------
    settings : CameraSettings
        ``id`` is the design; with ``rate`` frames come at that pace, or as fast as they are rendered.
    again : bool
        Whether to go on after the last position.

    Raises
    ------
    FileError
        No design, or one that cannot stand.
    """

    def __init__(self, settings: CameraSettings, *, again: bool = False) -> None:
        self._asked, self._again = settings, again
        self.rig = VirtualRig.of(read_design(Path(settings.id)))
        columns, rows = self.rig.camera.size
        self._info = CameraInfo("simulated", settings.id, f"virtual rig {Path(settings.id).stem}", (columns, rows))
        self._lights: OrderedDict[tuple[str, bool, int], Array] = OrderedDict()
        self.view = View()
        self.exposure = 1.0  # times the light of the design
        self.start()

    @property
    def planes(self) -> tuple[str, ...]:
        """Names of the places of the target on the jig."""
        return self.rig.design.jig.names

    @property
    def info(self) -> CameraInfo:
        """Driver, id, model and size."""
        return self._info

    @property
    def settings(self) -> Mapping[str, Setting]:
        """Exposure as microseconds of which 1000 are the light of the design."""
        return {"exposure_us": 1000.0 * self.exposure, "gain": 0.0, "rate": self._asked.rate}

    @property
    def dropped(self) -> int:
        """None is: a frame is rendered when it is read."""
        return 0

    @property
    def waits(self) -> bool:
        """Frames are rendered when they are read."""
        return True

    @property
    def switches_laser(self) -> bool:
        """It does."""
        return True

    def start(self) -> None:
        """Begin with the first frame of the motion."""
        design = self.rig.design
        self._number, self._began = 0, time.monotonic()
        self.frames = design.motion.frames if design.motion is not None else 1
        planes = len(design.jig.names)
        self._sources = np.random.default_rng(0).spawn(3 * planes + self.frames + 1)[3 * planes :]

    def read(self) -> Shot | None:
        """Next frame; None after the last of the motion."""
        if not self._again and self._number >= self.frames:
            return None
        k, self._number = self._number, self._number + 1
        at = k / (self._asked.rate or 25.0)
        image = self._image(k)
        if self._asked.rate is not None:
            time.sleep(max(0.0, self._began + at - time.monotonic()))
        return Shot(image, k, at)

    def skip(self, count: int) -> None:
        """Go on behind the next ``count`` frames."""
        self._number += count
        self._began -= count / (self._asked.rate or 25.0)

    def position(self, k: int) -> int:
        """Frame of the design's motion that the k-th frame shows: back and forth."""
        turn = k % max(1, 2 * (self.frames - 1))
        return min(turn, 2 * (self.frames - 1) - turn) if self.frames > 1 else 0

    def set(self, name: str, value: float) -> None:
        """Set the exposure; gain does nothing."""
        if name == "exposure_us":
            self.exposure = float(np.clip(value, 10.0, 100_000.0)) / 1000.0

    def switch_laser(self, on: bool) -> None:
        """Switch the laser of the virtual rig."""
        self.view = View(self.view.plane, on, self.view.moving)

    def show(self, view: View) -> None:
        """Put something else before the camera; ``FileError`` for a plane that the design does not have."""
        if view.plane and view.plane not in self.planes:
            raise FileError(f"{self._asked.id}: no stand-off {view.plane}; the design has {', '.join(self.planes)}")
        self.view = view

    def close(self) -> None:
        """Nothing is held open."""
        self._lights.clear()

    def _image(self, k: int) -> Any:
        position = self.position(k) if self.view.moving else self.frames // 2
        rng = self._sources[position] if not self._again else np.random.default_rng((position, k))
        if not self.view.laser and not self.view.plane:
            return self.rig.dark_images(1, rng)[0]
        if not self._again:  # as `scope simulate` renders it
            return self.rig.stripe_images(self.rig.scene.moved(self.rig.object_pose(position)), 1, rng)[0]
        return self._exposed(position, rng)

    def _exposed(self, position: int, rng: np.random.Generator) -> Any:
        """One exposure of light that was rendered before, where it was."""
        plane, laser = self.view.plane, self.view.laser
        key = (plane, laser, 0 if plane else position)
        if key not in self._lights:
            self._lights[key] = self._light(plane, position, laser=laser)
            if len(self._lights) > _KEPT:
                self._lights.popitem(last=False)
        return self.rig.exposed(self._lights[key] * self.exposure, rng, laser=laser)

    def _light(self, plane: str, position: int, *, laser: bool) -> Array:
        index = self.planes.index(plane) if plane else 0
        if plane and not laser:
            return self.rig.target_light(index)
        scene = self.rig.blank(index) if plane else self.rig.scene.moved(self.rig.object_pose(position))
        return self.rig.stripe_light(scene)
