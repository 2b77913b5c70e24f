"""Names of drivers to cameras: open one, list those that are connected."""

from __future__ import annotations

from calibration.errors import ScopeError
from scope.cameras.camera import Camera, CameraInfo
from scope.errors import MissingLibraryError
from scope.session import CameraSettings


def open_camera(settings: CameraSettings, *, again: bool = False) -> Camera:
    """Open a camera; nothing is taken before its `start`.

    Parameters
    ----------
    settings : CameraSettings
        Driver, id and how the camera is to be set.
    again : bool
        `replay` and `simulated`: go on from the beginning after the last frame, for a live view.

    Raises
    ------
    CameraError
        It does not answer, or refuses a setting.
    FileError
        `replay`, `simulated`: files that are not there or not what they should be.
    MissingLibraryError
        What the driver needs is not installed.
    """
    match settings.driver:
        case "replay":
            from scope.cameras.replay import ReplayCamera

            return ReplayCamera(settings, again=again)
        case "simulated":
            from scope.cameras.simulated import SimulatedCamera

            return SimulatedCamera(settings, again=again)
        case "v4l2":
            from scope.cameras.v4l2 import V4l2Camera

            return V4l2Camera(settings)
        case "aravis":
            from scope.cameras.aravis import AravisCamera

            return AravisCamera(settings)
        case "basler":
            from scope.cameras.basler import BaslerCamera

            return BaslerCamera(settings)
        case "genicam":
            from scope.cameras.genicam import GenicamCamera

            return GenicamCamera(settings)


def list_cameras(producer: str | None = None) -> tuple[list[CameraInfo], list[str]]:
    """Cameras that are connected, and a line for each driver that could not look.

    ``producer`` is the .cti file of a GenTL producer; without one `genicam` is not asked.
    """
    from scope.cameras.aravis import aravis_cameras
    from scope.cameras.basler import basler_cameras
    from scope.cameras.genicam import genicam_cameras
    from scope.cameras.v4l2 import v4l2_cameras

    found, silent = v4l2_cameras(), []
    for driver, look in (
        ("aravis", aravis_cameras),
        ("basler", basler_cameras),
        *([] if producer is None else [("genicam", lambda: genicam_cameras(producer))]),
    ):
        try:
            found += look()
        except MissingLibraryError as error:
            silent.append(f"{driver}: {error}")
        except ScopeError as error:
            silent.append(f"{driver}: {error}")
    return found, silent
