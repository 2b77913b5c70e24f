"""Surface roughness with the sensor's noise taken out: ISO 25178-2 and ISO 21920-2 parameters and how sure they are.

In: height maps of the patches asked for, and a repeated scan where there is one.
Out: `Roughness`: each parameter with its uncertainty, or withheld with the reason.
Read: run, measure, noise, align, estimate, areal, abbott, attenuation, sampling, gates, directions, profile,
    profile_noise, extras, table.
"""

from scope.roughness.abbott import AbbottCurve
from scope.roughness.measure import Roughness, RoughnessOptions, measure_heights, measure_roughness
from scope.roughness.run import options_from_text, run_roughness, write_heights
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
    "write_heights",
]
