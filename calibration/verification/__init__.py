"""A calibration proved by itself: the intra-plane and the inter-plane analysis, planes left out, faults by name.

In: all sightings of all marks, and the camera fitted to them.
Out: figures in px and mm, and faults: which plane, what is wrong with it, by how much, what to do.
Read: support, analysis, expectation, leave_out, observations, redundancy, misplacement, hypotheses, faults, mix_ups, rig_faults,
    wording.
"""

from calibration.verification.analysis import Interplane, Intraplane, beyond_reach, block_image, interplane, intraplane
from calibration.verification.expectation import RayBound, expected_interplane_px, ray_bound
from calibration.verification.faults import find_faults
from calibration.verification.leave_out import HeldOut, against, held_out, leave_views_out
from calibration.verification.rig_faults import faults_against
from calibration.verification.wording import Fault, Lattice, of_marks, of_too_many_marks

__all__ = [
    "Fault",
    "HeldOut",
    "Interplane",
    "Intraplane",
    "Lattice",
    "RayBound",
    "against",
    "beyond_reach",
    "block_image",
    "expected_interplane_px",
    "faults_against",
    "find_faults",
    "held_out",
    "interplane",
    "intraplane",
    "leave_views_out",
    "of_marks",
    "of_too_many_marks",
    "ray_bound",
]
