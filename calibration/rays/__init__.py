"""calibration.rays."""

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
