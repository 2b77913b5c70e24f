"""Driver `basler`: Basler cameras through pypylon (extra `basler`), whose emulator stands in where PYLON_CAMEMU says so."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from scope.cameras.camera import CameraInfo, Setting, Shot
from scope.cameras.genicam_nodes import FrameIds, laser_nodes
from scope.cameras.pixels import image_of
from scope.errors import CameraError, MissingLibraryError
from scope.session import CameraSettings

_BUFFERS = 24
_NODES = {  # by setting: the names that generations of cameras give it
    "exposure_us": ("ExposureTime", "ExposureTimeAbs"),
    "gain": ("Gain", "GainAbs"),
    "rate": ("AcquisitionFrameRate", "AcquisitionFrameRateAbs"),
    "pixel_format": ("PixelFormat",),
}


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


class BaslerCamera:
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

    @property
    def info(self) -> CameraInfo:
        """Driver, id, model and size."""
        return self._info

    @property
    def settings(self) -> Mapping[str, Setting]:
        """As the camera tells them; what it does not tell is None."""
        told: dict[str, Setting] = {}
        for name in _NODES:
            node = self._node(name)
            value = None if node is None else node.GetValue()
            told[name] = value if value is None or isinstance(value, str) else float(value)
        return {**told, "trigger": self._asked.trigger}

    @property
    def dropped(self) -> int:
        """By the numbers of the frames."""
        return self._ids.missing

    @property
    def waits(self) -> bool:
        """A camera does not wait."""
        return False

    @property
    def switches_laser(self) -> bool:
        """Where a line was named."""
        return self._asked.laser is not None

    def start(self) -> None:
        """Fill buffers from now on."""
        try:
            self._camera.StopGrabbing()
            self._ids = FrameIds()
            self._camera.MaxNumBuffer.Value = _BUFFERS
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
                raise CameraError(
                    f"{self._asked.name}: gave no frame for {self._asked.timeout_s:g} s; check cable, power and trigger"
                )
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

    def set(self, name: str, value: float) -> None:
        """Set "exposure_us" or "gain"."""
        self._write(name, value)

    def switch_laser(self, on: bool) -> None:
        """By the output line of the settings."""
        try:
            for name, value in laser_nodes(self._asked.laser, on=on):
                self._camera.GetNodeMap().GetNode(name).FromString(
                    str(value).lower() if isinstance(value, bool) else value
                )
        except (AttributeError, self._pylon.GenericException) as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Stop and let go."""
        with suppress(self._pylon.GenericException):
            self._camera.StopGrabbing()
            self._camera.Close()

    def _apply(self) -> None:
        asked = self._asked
        for name in ("pixel_format", "exposure_us", "gain"):
            if (value := getattr(asked, name)) is not None:
                self._write(name, value)
        if asked.trigger is not None:
            for name, value in (
                ("TriggerSelector", "FrameStart"),
                ("TriggerSource", asked.trigger),
                ("TriggerMode", "On"),
            ):
                self._camera.GetNodeMap().GetNode(name).FromString(value)
        elif asked.rate is not None:
            enable = self._camera.GetNodeMap().GetNode("AcquisitionFrameRateEnable")
            if enable is not None:
                enable.FromString("true")
            self._write("rate", asked.rate)

    def _node(self, setting: str) -> Any:
        nodes = (self._camera.GetNodeMap().GetNode(name) for name in _NODES[setting])
        return next((node for node in nodes if node is not None), None)

    def _write(self, setting: str, value: float | str) -> None:
        node = self._node(setting)
        if node is None:
            raise CameraError(f"{self._asked.name}: has no {setting}; leave it out")
        try:
            node.SetValue(value)
        except self._pylon.GenericException as error:
            raise CameraError(f"{self._asked.name}: refuses {setting} = {value}: {_told(error)}") from error

    def _failed(self, error: Exception) -> CameraError:
        return CameraError(
            f"{self._asked.name}: {_told(error)}; check cable and power, and that no other program uses it"
        )


def _told(error: Exception) -> str:
    """First sentence of pylon's message, without the place in its source."""
    return " ".join(str(error).split(" : ")[0].split())[:160]
