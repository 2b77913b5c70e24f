"""calibration.verification."""

from calibration.verification.analysis import Interplane, Intraplane, block_image, interplane, intraplane
from calibration.verification.faults import find_faults
from calibration.verification.leave_out import HeldOut, against, held_out, leave_views_out
from calibration.verification.rig_faults import faults_against
from calibration.verification.wording import Fault, Lattice

__all__ = [
    "Fault",
    "HeldOut",
    "Interplane",
    "Intraplane",
    "Lattice",
    "against",
    "block_image",
    "faults_against",
    "find_faults",
    "held_out",
    "interplane",
    "intraplane",
    "leave_views_out",
]
