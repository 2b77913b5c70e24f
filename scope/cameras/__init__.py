"""Cameras behind one protocol: drivers by name, frames with number and time stamp, what was lost counted.

In: the section [camera] of capture.toml or calibration.toml.
Out: an opened `Camera` and its `Shot`s; as the source of a scan, the same frames as from a folder.
Read: camera, drivers, source; the drivers replay, simulated, v4l2, aravis, basler, genicam; pixels,
    genicam_nodes.
"""

from scope.cameras.camera import Camera, CameraInfo, Shot
from scope.cameras.drivers import list_cameras, open_camera
from scope.cameras.replay import ReplayCamera
from scope.cameras.simulated import SimulatedCamera, View
from scope.cameras.source import CameraSource, Grabber, Placed, open_source

__all__ = [
    "Camera",
    "CameraInfo",
    "CameraSource",
    "Grabber",
    "Placed",
    "ReplayCamera",
    "Shot",
    "SimulatedCamera",
    "View",
    "list_cameras",
    "open_camera",
    "open_source",
]
