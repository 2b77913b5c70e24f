"""A region of a cloud to heights on a lattice, with the form taken off: what roughness is measured on.

In: a cloud and a region, a mesh as nominal form, or a height map file.
Out: `HeightMap` with gaps and sigma; its form, filtered parts and spectrum.
    Of a cloud without a region: the flat patches in it.
Read: heights, patch, form, filters, edges, model, spatial, files, flat.
"""

from scope.heightmap.edges import refuse_edges
from scope.heightmap.files import ENDINGS, NoLatticeError, read_heights, within
from scope.heightmap.filters import (
    ALPHA,
    SAMPLES_PER_INDEX,
    gaussian,
    l_filter,
    least_s_index,
    local_roughness,
    s_filter,
)
from scope.heightmap.flat import FlatPatch, flat_patches
from scope.heightmap.form import remove_form, require_form
from scope.heightmap.heights import HeightMap
from scope.heightmap.model import remove_model
from scope.heightmap.patch import DEEPEST, LEAST_POINTS, patch_heights
from scope.heightmap.spatial import ISOTROPIC, Autocorrelation, Texture, autocorrelation, power_spectrum, texture

__all__ = [
    "ALPHA",
    "Autocorrelation",
    "DEEPEST",
    "ENDINGS",
    "FlatPatch",
    "HeightMap",
    "ISOTROPIC",
    "LEAST_POINTS",
    "NoLatticeError",
    "SAMPLES_PER_INDEX",
    "Texture",
    "autocorrelation",
    "flat_patches",
    "gaussian",
    "l_filter",
    "least_s_index",
    "local_roughness",
    "patch_heights",
    "power_spectrum",
    "read_heights",
    "refuse_edges",
    "remove_form",
    "remove_model",
    "require_form",
    "s_filter",
    "texture",
    "within",
]
