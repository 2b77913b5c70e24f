"""What people write and cameras give: TOML files read and refused in one line, images and frames in order.

In: calibration.toml, capture.toml, folders of images, videos; or the same from memory.
Out: frozen descriptions of a calibration or a capture, and a source that decodes its frames ahead.
Read: toml_file, camera_section, target_section, calibration_file, in_memory, robot_section, hand_eye_file,
    hand_eye, following, positions, capture, images, frames, templates, commented.
"""

from scope.session.calibration_file import (
    CalibrationPlan,
    LaserPlan,
    ListedMarks,
    PlanePlan,
    PlannedPlane,
    StagePlan,
    planned_camera,
    planned_limits,
    planned_planes,
    planned_views,
    read_calibration,
)
from scope.session.camera_section import DRIVERS, ON_FILES, CameraSection, CameraSettings, camera_settings
from scope.session.capture import Capture, StageUse, read_capture
from scope.session.commented import FILES, write_commented
from scope.session.following import Clock, Follow, Follower
from scope.session.frames import (
    AHEAD,
    HELD,
    Folder,
    Frame,
    Iterated,
    Source,
    frames_in_memory,
    in_order,
    open_source,
    open_video,
)
from scope.session.hand_eye import SENSOR, TARGET, HandEye
from scope.session.hand_eye_file import HandEyePlan, read_hand_eye_plan
from scope.session.images import (
    ENDINGS,
    ImageInMemory,
    gray,
    image_files,
    mean_gray,
    mean_image,
    read_alike,
    read_image,
    save_image,
    save_images,
    shape_text,
)
from scope.session.in_memory import CalibrationSession, PlaneView, plan_of
from scope.session.robot_section import PoseLog, PoseTrack, read_pose_log
from scope.session.target_section import Plate, read_target, target_in
from scope.session.templates import TEMPLATES, write_template
from scope.session.toml_file import MM, Positive, Section, Units, Vector, matching, read_toml

__all__ = [
    "AHEAD",
    "CalibrationPlan",
    "CalibrationSession",
    "CameraSection",
    "CameraSettings",
    "Capture",
    "Clock",
    "DRIVERS",
    "ENDINGS",
    "FILES",
    "Folder",
    "Follow",
    "Follower",
    "Frame",
    "HELD",
    "HandEye",
    "HandEyePlan",
    "ImageInMemory",
    "Iterated",
    "LaserPlan",
    "ListedMarks",
    "MM",
    "ON_FILES",
    "PlanePlan",
    "PlaneView",
    "PlannedPlane",
    "Plate",
    "Positive",
    "Section",
    "Units",
    "Vector",
    "PoseLog",
    "PoseTrack",
    "SENSOR",
    "Source",
    "StagePlan",
    "StageUse",
    "TARGET",
    "TEMPLATES",
    "camera_settings",
    "frames_in_memory",
    "gray",
    "image_files",
    "in_order",
    "matching",
    "mean_gray",
    "mean_image",
    "open_source",
    "open_video",
    "plan_of",
    "planned_camera",
    "planned_limits",
    "planned_planes",
    "planned_views",
    "read_alike",
    "read_calibration",
    "read_capture",
    "read_hand_eye_plan",
    "read_image",
    "save_image",
    "save_images",
    "read_pose_log",
    "read_target",
    "read_toml",
    "shape_text",
    "target_in",
    "write_commented",
    "write_template",
]
