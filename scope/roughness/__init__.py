"""scope.roughness."""

from scope.roughness.abbott import AbbottCurve
from scope.roughness.measure import Roughness, RoughnessOptions, measure_heights, measure_roughness
from scope.roughness.run import options_from_text, run_roughness
from scope.roughness.table import AREAL, PROFILE, Definition, Parameter

__all__ = [
    "AREAL",
    "AbbottCurve",
    "Definition",
    "PROFILE",
    "Parameter",
    "Roughness",
    "RoughnessOptions",
    "measure_heights",
    "measure_roughness",
    "options_from_text",
    "run_roughness",
]
