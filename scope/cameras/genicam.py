"""Driver `genicam`: any camera with a GenTL producer (.cti), through harvesters (extra `genicam`)."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import FileError
from scope.cameras.camera import CameraInfo, Shot
from scope.cameras.genicam_nodes import BUFFERS, FrameIds, NodeCamera
from scope.cameras.pixels import image_of
from scope.errors import CameraError, MissingLibraryError
from scope.session import CameraSettings


def _harvester(producer: str) -> Any:
    try:
        from harvesters.core import Harvester
    except ImportError as error:
        raise MissingLibraryError(
            "the Python package harvesters is not installed, which GenTL cameras need; run: python -m pip install "
            '"scope-scanner[genicam]"'
        ) from error
    if not Path(producer).is_file():
        raise FileError(
            f"{producer}: is not there; camera.producer names the .cti file that the camera's maker installs"
        )
    harvester = Harvester()
    harvester.add_file(producer, check_existence=True, check_validity=True)
    harvester.update()
    return harvester


def genicam_cameras(producer: str) -> list[CameraInfo]:
    """Cameras that a GenTL producer finds."""
    harvester = _harvester(producer)
    try:
        return [
            CameraInfo("genicam", str(device.id_), f"{device.vendor} {device.model}".strip(), None)
            for device in harvester.device_info_list
        ]
    finally:
        harvester.reset()


class GenicamCamera(NodeCamera):
    """One camera of a producer; ``CameraError`` where it does not answer or refuses a setting that was asked for."""

    def __init__(self, settings: CameraSettings) -> None:
        self._asked = settings
        self._acquirer: Any = None
        try:
            self._harvester = _harvester(settings.producer or "")
        except (OSError, RuntimeError, ValueError) as error:
            raise self._failed(error) from error
        try:
            infos = self._harvester.device_info_list
            wanted = [k for k, device in enumerate(infos) if settings.id in ("", str(device.id_))]
            if not wanted:
                raise CameraError(
                    f"{settings.name}: none answers at {Path(settings.producer or '').name}; check cable and power"
                )
            self._acquirer = self._harvester.create(wanted[0])
            self._acquirer.num_buffers = BUFFERS
            self._apply()
            nodes, device = self._acquirer.remote_device.node_map, infos[wanted[0]]
            size = (int(nodes.Width.value), int(nodes.Height.value))
            self._info = CameraInfo("genicam", str(device.id_), f"{device.vendor} {device.model}".strip(), size)
        except CameraError:
            self.close()
            raise
        except Exception as error:  # harvesters hands on what producers throw, of any kind
            self.close()
            raise self._failed(error) from error
        self._ids = FrameIds()

    def start(self) -> None:
        """Fill buffers from now on."""
        try:
            self._acquirer.stop()
            self._ids = FrameIds()
            self._acquirer.start()
        except Exception as error:
            raise self._failed(error) from error

    def read(self) -> Shot | None:
        """Next whole frame."""
        try:
            with self._acquirer.fetch(timeout=self._asked.timeout_s) as buffer:
                part = buffer.payload.components[0]
                stamp = float(buffer.timestamp_ns or time.monotonic_ns()) * 1e-9
                number, at = self._ids.next(int(buffer.frame_id or self._ids.count + 1), stamp)
                data = np.ascontiguousarray(part.data).view(np.uint8).ravel()
                return Shot(
                    image_of(data, part.width, part.height, part.data_format, self._asked.name), number, at, stamp=stamp
                )
        except CameraError:
            raise
        except Exception as error:
            raise CameraError(f"{self._silent()} ({self._told(error)})") from error

    def close(self) -> None:
        """Stop and let go."""
        with suppress(Exception):
            if self._acquirer is not None:
                self._acquirer.stop()
                self._acquirer.destroy()
        with suppress(Exception):
            self._harvester.reset()

    def _find(self, name: str) -> Any:
        return getattr(self._acquirer.remote_device.node_map, name, None)

    def _get(self, node: Any) -> Any:
        return getattr(node, "value", None)

    def _put(self, node: Any, value: float | str | bool) -> None:
        node.value = value
