"""Driver `aravis`: GigE Vision and USB3 Vision cameras of any maker, through the system's libaravis."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from scope.cameras._aravis_library import STATUS, SUCCESS, aravis
from scope.cameras.camera import CameraInfo, Setting, Shot
from scope.cameras.genicam_nodes import BUFFERS, FrameIds, LiveCamera, laser_nodes
from scope.cameras.pixels import image_of
from scope.errors import CameraError
from scope.session import CameraSettings


def aravis_cameras() -> list[CameraInfo]:
    """Cameras that answer on the network and USB; looking takes a second."""
    library = aravis()
    library.arv_update_device_list()
    found = []
    for k in range(library.arv_get_n_devices()):
        identity, vendor, model = (
            (getattr(library, f"arv_get_device_{what}")(k) or b"").decode("utf-8", "replace")
            for what in ("id", "vendor", "model")
        )
        found.append(CameraInfo("aravis", identity, f"{vendor} {model}".strip(), _size(identity)))
    return found


def _first() -> str:
    return (aravis().arv_get_device_id(0) or b"").decode("utf-8", "replace")


def _size(identity: str) -> tuple[int, int] | None:
    """Size of the frames of a camera that nobody uses; None where it cannot be opened."""
    library, camera = aravis(), None
    try:
        camera = library.call("", "arv_camera_new", identity.encode())
        return _region(camera, "")
    except CameraError:
        return None
    finally:
        library.release(camera)


def _region(camera: int, name: str) -> tuple[int, int]:
    x, y, width, height = (ctypes.c_int() for _ in range(4))
    aravis().call(name, "arv_camera_get_region", camera, *(ctypes.byref(each) for each in (x, y, width, height)))
    return width.value, height.value


class AravisCamera(LiveCamera):
    """One camera; ``CameraError`` where it does not answer or refuses a setting that was asked for."""

    def __init__(self, settings: CameraSettings) -> None:
        self._asked, self._library = settings, aravis()
        self._camera: Any = None
        self._stream: Any = None
        self._running = False
        self._library.arv_update_device_list()
        try:
            self._camera = self._call("arv_camera_new", settings.id.encode() if settings.id else None)
            if not self._camera:
                raise CameraError(
                    f"{settings.name}: none answers; check cable, power and network address, see scope cameras"
                )
            model = (self._call("arv_camera_get_model_name", self._camera) or b"").decode("utf-8", "replace")
            self._apply()
            self._info = CameraInfo("aravis", settings.id or _first(), model, _region(self._camera, settings.name))
        except CameraError:
            self.close()
            raise
        self._ids = FrameIds()
        self._broken = 0

    @property
    def settings(self) -> Mapping[str, Setting]:
        """As the camera tells them; what it does not tell is None."""
        told: dict[str, Setting] = {}
        for name, function in (
            ("exposure_us", "arv_camera_get_exposure_time"),
            ("gain", "arv_camera_get_gain"),
            ("rate", "arv_camera_get_frame_rate"),
            ("pixel_format", "arv_camera_get_pixel_format_as_string"),
        ):
            try:
                value = self._call(function, self._camera)
            except CameraError:
                value = None
            told[name] = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        return {**told, "trigger": self._asked.trigger}

    def start(self) -> None:
        """Fill buffers from now on."""
        self._stop()
        self._ids, self._broken = FrameIds(), 0
        self._stream = self._call("arv_camera_create_stream", self._camera, None, None)
        if not self._stream:
            raise CameraError(f"{self._asked.name}: gives no stream; another program may use it: close that")
        payload = self._call("arv_camera_get_payload", self._camera)
        for _ in range(BUFFERS):
            self._library.arv_stream_push_buffer(self._stream, self._library.arv_buffer_new(payload, None))
        self._call("arv_camera_start_acquisition", self._camera)
        self._running = True

    def read(self) -> Shot | None:
        """Next whole frame; one that lacks packets is counted as dropped."""
        while True:
            buffer = self._library.arv_stream_timeout_pop_buffer(self._stream, int(self._asked.timeout_s * 1e6))
            if not buffer:
                raise self._silent()
            try:
                shot = self._shot(buffer)
            finally:
                self._library.arv_stream_push_buffer(self._stream, buffer)
            if shot is not None:
                return shot

    def _shot(self, buffer: int) -> Shot | None:
        library = self._library
        status = library.arv_buffer_get_status(buffer)
        if status != SUCCESS:
            self._broken += 1
            if self._broken > 100 and self._ids.count == 0:
                raise CameraError(
                    f"{self._asked.name}: no whole frame in {self._broken} ({STATUS.get(status, status)}); check the network "
                    "(packet size, one camera a link)"
                )
            return None
        stamp = library.arv_buffer_get_timestamp(buffer) * 1e-9
        number, at = self._ids.next(library.arv_buffer_get_frame_id(buffer), stamp)
        size = ctypes.c_size_t()
        start = library.arv_buffer_get_data(buffer, ctypes.byref(size))
        data = np.ctypeslib.as_array((ctypes.c_uint8 * size.value).from_address(start))
        width, height = library.arv_buffer_get_image_width(buffer), library.arv_buffer_get_image_height(buffer)
        kind = library.arv_buffer_get_image_pixel_format(buffer)
        return Shot(image_of(data, width, height, kind, self._asked.name), number, at, stamp=stamp)

    def set(self, name: str, value: float) -> None:
        """Set "exposure_us" or "gain"."""
        self._call(f"arv_camera_set_{'exposure_time' if name == 'exposure_us' else 'gain'}", self._camera, float(value))

    def switch_laser(self, on: bool) -> None:
        """By the output line of the settings."""
        for feature, value in laser_nodes(self._asked.laser, on=on):
            if isinstance(value, bool):
                self._call("arv_camera_set_boolean", self._camera, feature.encode(), value)
            else:
                self._call("arv_camera_set_string", self._camera, feature.encode(), value.encode())

    def close(self) -> None:
        """Stop and let go."""
        self._stop()
        self._library.release(self._camera)
        self._camera = None

    def _stop(self) -> None:
        if self._running and self._camera:
            with suppress(CameraError):  # it may be gone
                self._call("arv_camera_stop_acquisition", self._camera)
        self._running = False
        self._library.release(self._stream)
        self._stream = None

    def _apply(self) -> None:
        asked, camera = self._asked, self._camera
        if asked.pixel_format is not None:
            self._call("arv_camera_set_pixel_format_from_string", camera, asked.pixel_format.encode())
        if asked.trigger is not None:
            self._call("arv_camera_set_trigger", camera, asked.trigger.encode())
        elif asked.rate is not None:
            self._call("arv_camera_set_frame_rate", camera, asked.rate)
        self._call("arv_camera_set_acquisition_mode", camera, 0)  # continuous
        for name in ("exposure_us", "gain"):
            if (value := getattr(asked, name)) is not None:
                self.set(name, value)

    def _call(self, function: str, *arguments: Any) -> Any:
        return self._library.call(self._asked.name, function, *arguments)
