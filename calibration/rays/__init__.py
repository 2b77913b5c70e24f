"""Marks on known planes to sighting rays: one camera model beside the other, all with the same `rays(pixels)`.

In: pixels (N, 2) of marks, their covariance, and where the marks stand (N, 3) on each plane or view.
Out: a camera: maps of two planes and more, one smooth field of rays, or a pinhole; with the covariance of its
    fit.
Read: polynomial, chebyshev, plane_map, two_plane, ray_field, pinhole, target_pose, uncertainty.
"""

from calibration.rays.pinhole import FreehandFit, PinholeCamera, fit_freehand, refit_without
from calibration.rays.plane_map import MAX_ORDER, Order, PlaneMap, PlaneMarks, fit_plane_map, normal_equations, rms
from calibration.rays.polynomial import Domain, exponents
from calibration.rays.ray_field import RayField, depth_frame, fit_ray_field
from calibration.rays.target_pose import centre_covariance, locate_target
from calibration.rays.two_plane import TwoPlaneCamera, TwoPlaneFit, fit_two_plane
from calibration.rays.uncertainty import ray_uncertainty

__all__ = [
    "Domain",
    "FreehandFit",
    "MAX_ORDER",
    "Order",
    "PinholeCamera",
    "PlaneMap",
    "PlaneMarks",
    "RayField",
    "TwoPlaneCamera",
    "TwoPlaneFit",
    "centre_covariance",
    "depth_frame",
    "exponents",
    "fit_freehand",
    "fit_plane_map",
    "fit_ray_field",
    "fit_two_plane",
    "locate_target",
    "normal_equations",
    "ray_uncertainty",
    "refit_without",
    "rms",
]
