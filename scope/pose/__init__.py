"""Where a known part is, with covariance; or that it cannot be told.

In: a cloud, with where camera and laser stood if it knows, and a `Model`.
Out: `PoseResult`: cloud_from_model, covariance, runner-up and margin; refused where another pose explains as
    much, or where it is another part, and then in what it differs.
Read: placed, estimate, answer, segmentation, glance, search, piece, visibility, decision, rim, borders, uncertainty,
    residuals, wording, several.
"""

from scope.pose.answer import Candidate, PoseOptions, PoseResult
from scope.pose.decision import Difference, difference
from scope.pose.estimate import estimate_pose
from scope.pose.placed import Placed, frame_of, place, read_robot_from_camera, read_transform, write_deviation
from scope.pose.residuals import FaceResidual
from scope.pose.search import normals_of, thin
from scope.pose.segmentation import largest_plane
from scope.pose.several import BAD_DATA, Sighted, Told, poses_of, poses_table, sighted_result
from scope.pose.uncertainty import shared_errors
from scope.pose.visibility import sheet_and_window, viewpoints
from scope.pose.wording import CONVENTION, notations_text, pose_json, pose_result, pose_text

__all__ = [
    "BAD_DATA",
    "CONVENTION",
    "Candidate",
    "Difference",
    "FaceResidual",
    "Placed",
    "PoseOptions",
    "PoseResult",
    "Sighted",
    "difference",
    "estimate_pose",
    "frame_of",
    "largest_plane",
    "normals_of",
    "notations_text",
    "place",
    "pose_json",
    "pose_result",
    "pose_text",
    "Told",
    "poses_of",
    "poses_table",
    "read_robot_from_camera",
    "read_transform",
    "shared_errors",
    "sheet_and_window",
    "sighted_result",
    "thin",
    "viewpoints",
    "write_deviation",
]
