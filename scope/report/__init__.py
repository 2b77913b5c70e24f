"""Results as self-contained pages, with figures in mm, pictures and the cloud to be turned.

In: a calibration, a scan, roughness, a pose, a check, a cloud.
Out: one HTML file each, and the tables that the terminal prints.
Read: page, pictures, freehand, calibration, scan, roughness, part, pose, check, certificate, hand_eye, merge, inspection, view.
"""

from scope.report.calibration import (
    calibration_page,
    calibration_text,
    check_text,
    verification_page,
    verification_text,
)
from scope.report.certificate import certificate_page
from scope.report.check import check_page
from scope.report.hand_eye import hand_eye_page
from scope.report.inspection import inspection_page
from scope.report.merge import merge_page
from scope.report.page import Level, Page, linked, signed
from scope.report.pictures import grey_blocks, with_marks, with_stripe
from scope.report.pose import pose_html
from scope.report.roughness import roughness_csv, roughness_page, roughness_text
from scope.report.scan import add_views, scan_page, scan_result, scan_text, why_no_point
from scope.report.view import view_page
from scope.viewer import cloud_from, colour_bgr

__all__ = [
    "inspection_page",
    "merge_page",
    "Level",
    "Page",
    "add_views",
    "calibration_page",
    "calibration_text",
    "certificate_page",
    "check_page",
    "check_text",
    "colour_bgr",
    "cloud_from",
    "grey_blocks",
    "hand_eye_page",
    "linked",
    "pose_html",
    "roughness_csv",
    "roughness_page",
    "roughness_text",
    "scan_page",
    "scan_result",
    "scan_text",
    "signed",
    "verification_page",
    "verification_text",
    "view_page",
    "with_marks",
    "with_stripe",
    "why_no_point",
]
