"""MCAP for ROS 2 and Foxglove: the cloud as sensor_msgs/PointCloud2, camera and lasers as tf; no ROS is needed to write it.

Lengths are metres, as ROS has them (REP 103); ``scope_cloud`` is the frame of the cloud, ``scope_camera`` that of the camera (C), and
``scope_laser_0`` stands where the laser is, not turned. A cloud knows frames and no times: its first frame is stamped with 1 s,
and each further one with a tenth of a second more.

Sources: the interface definitions of sensor_msgs, tf2_msgs, geometry_msgs, std_msgs and builtin_interfaces (ROS 2); MCAP specification.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from calibration.atomic import written_whole
from calibration.geometry import quaternion_from_rotation
from scope.cloud import ScanCloud, comments, vertex_records
from scope.errors import MeasurementError, MissingLibraryError

CLOUD, CAMERA, LASER = "scope_cloud", "scope_camera", "scope_laser_{}"
CLOUD_TOPIC, TF_TOPIC = "/scope/cloud", "/tf"
START, PERIOD = 1_000_000_000, 100_000_000  # ns: stamp of the first frame, and between two frames
_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}  # sensor_msgs/PointField
_MOST = (1 << 32) - 1  # bytes of a sequence

_LINE = "=" * 80
_TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
POINT_CLOUD = f"""\
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
{_LINE}
{_HEADER}{_LINE}
{_TIME}{_LINE}
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
"""
TF = f"""\
geometry_msgs/TransformStamped[] transforms
{_LINE}
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{_LINE}
{_HEADER}{_LINE}
{_TIME}{_LINE}
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{_LINE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_LINE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


def write(path: Path, cloud: ScanCloud) -> None:
    """Write a cloud as MCAP; ``MissingLibraryError`` without mcap-ros2-support."""
    try:
        writers = importlib.import_module("mcap_ros2.writer")
    except ImportError as error:
        raise MissingLibraryError(
            f"{path}: MCAP needs the package mcap-ros2-support ({error.name}); install it: pip install 'scope-scanner[ros2]'"
        ) from error
    message = _point_cloud(path, cloud)
    with written_whole(path) as stream:
        writer = writers.Writer(stream)
        clouds = writer.register_msgdef("sensor_msgs/msg/PointCloud2", POINT_CLOUD)
        transforms = writer.register_msgdef("tf2_msgs/msg/TFMessage", TF)
        writer.write_message(CLOUD_TOPIC, clouds, message, log_time=START, publish_time=START)
        for k, (stamp, moved) in enumerate(_transforms(cloud)):
            writer.write_message(TF_TOPIC, transforms, {"transforms": moved}, stamp, stamp, sequence=k)
        told = [text.split(" ", 1) for text in comments(cloud)]
        writer.add_metadata("scope", {words[0]: words[-1] for words in told} | {"lengths": "m"})
        writer.finish()


def _point_cloud(path: Path, cloud: ScanCloud) -> dict[str, Any]:
    own = vertex_records(cloud)
    names = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
    rows = own.astype([(names.get(name, name), own.dtype[name]) for name in own.dtype.names or ()])
    for axis, values in zip("xyz", cloud.points.T, strict=True):
        rows[axis] = values * 1e-3
    for name in ("sigma", "sigma_cal"):
        rows[name] = own[name].astype(np.float64) * 1e-3
    if rows.nbytes > _MOST:
        raise MeasurementError(
            f"{path}: {len(cloud)} points need {rows.nbytes} bytes and a message holds {_MOST}; thin the cloud"
        )
    fields = [
        {"name": name, "offset": int(rows.dtype.fields[name][1]), "datatype": _DATATYPES[rows.dtype[name].str[1:]], "count": 1}
        for name in rows.dtype.names or ()
        if rows.dtype.fields is not None
    ]  # fmt: skip
    return {
        "header": {"stamp": _stamp(START), "frame_id": CLOUD},
        "height": 1,
        "width": len(rows),
        "fields": fields,
        "is_bigendian": False,
        "point_step": rows.dtype.itemsize,
        "row_step": rows.nbytes,
        "data": rows.tobytes(),
        "is_dense": True,
    }


def _transforms(cloud: ScanCloud) -> list[tuple[int, list[dict[str, Any]]]]:
    """Stamp (ns) and transforms of each frame of which the cloud knows where the camera was."""
    sensors = cloud.sensors
    if sensors is None or len(sensors) == 0:
        return []
    first, found = int(sensors.frame.min()), []
    for frame in np.unique(sensors.frame):
        stamp = START + PERIOD * (int(frame) - first)
        moved = []
        if np.isfinite(cloud.camera_centre).all():
            pose = cloud.cloud_from_camera(int(frame))
            moved.append(_transform(stamp, CAMERA, pose.translation, quaternion_from_rotation(pose.rotation)))
        for row in np.flatnonzero(sensors.frame == frame):
            origin = sensors.laser_origin[row]
            if np.isfinite(origin).all():
                child = LASER.format(int(sensors.laser[row]))
                moved.append(_transform(stamp, child, origin, np.array([1.0, 0.0, 0.0, 0.0])))
        if moved:
            found.append((stamp, moved))
    return found


def _transform(stamp: int, child: str, translation: Any, quaternion: Any) -> dict[str, Any]:
    x, y, z = (float(value) * 1e-3 for value in translation)
    w, i, j, k = (float(value) for value in quaternion)
    return {
        "header": {"stamp": _stamp(stamp), "frame_id": CLOUD},
        "child_frame_id": child,
        "transform": {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": i, "y": j, "z": k, "w": w}},
    }


def _stamp(nanoseconds: int) -> dict[str, int]:
    return {"sec": nanoseconds // 1_000_000_000, "nanosec": nanoseconds % 1_000_000_000}
