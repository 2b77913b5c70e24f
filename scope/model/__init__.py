"""A known part, prepared once: what searching and refining a pose need of its mesh.

In: a mesh file, units mm.
Out: `Model`: exact surface, signed distance on a grid, samples, views, symmetries.
Read: files, surface, model, grid, alignment, features.
"""

from scope.model.alignment import Fit, Scanned, Weighting, evaluate, patches, refine
from scope.model.features import Edges, Features, FlatFace, RoundFeature, features_of
from scope.model.files import load_model
from scope.model.grid import align, hidden, passes
from scope.model.model import Model, angle_between, distinct, fibonacci_sphere, rotations
from scope.model.surface import Surface

__all__ = [
    "Edges",
    "Features",
    "Fit",
    "FlatFace",
    "Model",
    "RoundFeature",
    "Scanned",
    "Surface",
    "Weighting",
    "align",
    "angle_between",
    "distinct",
    "evaluate",
    "features_of",
    "fibonacci_sphere",
    "hidden",
    "load_model",
    "passes",
    "patches",
    "refine",
    "rotations",
]
