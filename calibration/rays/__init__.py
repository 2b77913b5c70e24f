"""Marks on known planes to sighting rays: one camera model beside the other, all with the same `rays(pixels)`.

In: pixels (N, 2) of marks, their covariance, and where the marks stand (N, 3) on each plane or view.
Out: a camera: maps of two planes and more, one smooth field of rays, or a pinhole; with the covariance of its
    fit.
Read: polynomial, chebyshev, plane_map, bad_marks, two_plane, ray_field, bundle, lens_terms, pinhole, coverage,
    target_pose, uncertainty.
"""

from calibration.rays.bad_marks import MOST_BAD, BadMarks, find_bad_marks
from calibration.rays.bundle import Term
from calibration.rays.coverage import Coverage, NextView, coverage_of, folds, next_view, undetermined
from calibration.rays.lens_terms import TERMS
from calibration.rays.pinhole import FreehandFit, PinholeCamera, fit_freehand, refit_without
from calibration.rays.plane_map import MAX_ORDER, Order, PlaneMap, PlaneMarks, fit_plane_map, normal_equations, rms
from calibration.rays.polynomial import Domain, exponents
from calibration.rays.ray_field import RayField, depth_frame, fit_ray_field
from calibration.rays.target_pose import centre_covariance, locate_target
from calibration.rays.two_plane import TwoPlaneCamera, TwoPlaneFit, fit_two_plane
from calibration.rays.uncertainty import ray_uncertainty

__all__ = [
    "MOST_BAD",
    "BadMarks",
    "find_bad_marks",
    "centre_covariance",
    "Coverage",
    "coverage_of",
    "depth_frame",
    "Domain",
    "exponents",
    "fit_freehand",
    "fit_plane_map",
    "fit_ray_field",
    "fit_two_plane",
    "folds",
    "FreehandFit",
    "locate_target",
    "MAX_ORDER",
    "next_view",
    "NextView",
    "normal_equations",
    "Order",
    "PinholeCamera",
    "PlaneMap",
    "PlaneMarks",
    "ray_uncertainty",
    "RayField",
    "refit_without",
    "rms",
    "Term",
    "TERMS",
    "TwoPlaneCamera",
    "TwoPlaneFit",
    "undetermined",
]
