"""Where is the part? `python pose_for_a_robot.py cloud.ply part.stl`; exit status 3 where it cannot be told."""

import sys

import numpy as np

import scope

result = scope.estimate_pose(scope.ScanCloud.load(sys.argv[1]), sys.argv[2])
if not result.found:
    print(result.why, result.tell_apart)
    sys.exit(3)
robot_from_camera = scope.Pose.from_rotation_vector([0.0, 0.0, 0.0], [400.0, 0.0, 250.0])  # as the cell knows it
with np.printoptions(precision=4, suppress=True):
    print((robot_from_camera @ result.cloud_from_model).matrix)
print(result)
