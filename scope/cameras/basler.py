"""Driver `basler`: Basler cameras through pypylon (extra `basler`), whose emulator stands in where PYLON_CAMEMU says so."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import numpy as np

from scope.cameras.camera import CameraInfo, Shot
from scope.cameras.genicam_nodes import BUFFERS, FrameIds, NodeCamera
from scope.cameras.pixels import image_of
from scope.errors import CameraError, MissingLibraryError
from scope.session import CameraSettings


def _pylon() -> Any:
    try:
        from pypylon import pylon
    except ImportError as error:
        raise MissingLibraryError(
            "the Python package pypylon is not installed, which Basler cameras need; run: python -m pip install "
            '"scope-scanner[basler]"'
        ) from error
    return pylon


def basler_cameras() -> list[CameraInfo]:
    """Cameras that pylon finds, by their serial numbers."""
    pylon = _pylon()
    found = []
    for device in pylon.TlFactory.GetInstance().EnumerateDevices():
        found.append(CameraInfo("basler", device.GetSerialNumber(), f"Basler {device.GetModelName()}", _size(device)))
    return found


def _size(device: Any) -> tuple[int, int] | None:
    pylon = _pylon()
    camera = None
    try:
        camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateDevice(device))
        camera.Open()
        return int(camera.Width.Value), int(camera.Height.Value)
    except pylon.GenericException:
        return None  # somebody uses it
    finally:
        if camera is not None:
            with suppress(pylon.GenericException):
                camera.Close()


class BaslerCamera(NodeCamera):
    """One camera; ``CameraError`` where it does not answer or refuses a setting that was asked for."""

    def __init__(self, settings: CameraSettings) -> None:
        self._asked, self._pylon = settings, _pylon()
        pylon = self._pylon
        try:
            devices = pylon.TlFactory.GetInstance().EnumerateDevices()
            wanted = [device for device in devices if settings.id in ("", device.GetSerialNumber())]
            if not wanted:
                raise CameraError(
                    f"{settings.name}: none answers; check cable, power and network address, see scope cameras"
                )
            self._camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateDevice(wanted[0]))
            self._camera.Open()
        except pylon.GenericException as error:
            raise self._failed(error) from error
        self._ids = FrameIds()
        try:
            self._apply()
            size = (int(self._camera.Width.Value), int(self._camera.Height.Value))
            device = self._camera.GetDeviceInfo()
            self._info = CameraInfo("basler", device.GetSerialNumber(), f"Basler {device.GetModelName()}", size)
        except pylon.GenericException as error:
            self.close()
            raise self._failed(error) from error
        except CameraError:
            self.close()
            raise

    def start(self) -> None:
        """Fill buffers from now on."""
        try:
            self._camera.StopGrabbing()
            self._ids = FrameIds()
            self._camera.MaxNumBuffer.Value = BUFFERS
            self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
        except self._pylon.GenericException as error:
            raise self._failed(error) from error

    def read(self) -> Shot | None:
        """Next whole frame; one that lacks packets counts as dropped."""
        while True:
            try:
                found = self._camera.RetrieveResult(
                    int(self._asked.timeout_s * 1000), self._pylon.TimeoutHandling_Return
                )
            except self._pylon.GenericException as error:
                raise self._failed(error) from error
            if not found.IsValid():
                raise self._silent()
            try:
                if not found.GrabSucceeded():
                    continue  # its number is missing from the next one's
                stamp = (found.TimeStamp or time.monotonic_ns()) * 1e-9
                number, at = self._ids.next(found.BlockID, stamp)
                kind = int(found.GetPixelType()) & 0xFFFFFFFF
                data = np.frombuffer(found.GetBuffer(), dtype=np.uint8)
                return Shot(image_of(data, found.Width, found.Height, kind, self._asked.name), number, at, stamp=stamp)
            finally:
                found.Release()

    def close(self) -> None:
        """Stop and let go."""
        with suppress(self._pylon.GenericException):
            self._camera.StopGrabbing()
            self._camera.Close()

    def _find(self, name: str) -> Any:
        return self._camera.GetNodeMap().GetNode(name)

    def _get(self, node: Any) -> Any:
        return node.GetValue()

    def _put(self, node: Any, value: float | str | bool) -> None:
        if isinstance(value, float):
            node.SetValue(value)
        else:
            node.FromString(str(value).lower() if isinstance(value, bool) else str(value))

    @staticmethod
    def _told(error: Exception) -> str:
        """First sentence of pylon's message, without the place in its source."""
        return " ".join(str(error).split(" : ")[0].split())[:160] or type(error).__name__
