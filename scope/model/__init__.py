"""A known part, prepared once: what searching and refining a pose need of its mesh.

In: a mesh file, units mm.
Out: `Model`: exact surface, signed distance on a grid, samples, views, symmetries.
Read: files, surface, model, grid, alignment.
"""

from scope.model.alignment import Fit, evaluate, refine
from scope.model.files import load_model
from scope.model.grid import align, hidden, passes
from scope.model.model import Model, angle_between, distinct, fibonacci_sphere, rotations
from scope.model.surface import Surface

__all__ = [
    "Fit",
    "Model",
    "Surface",
    "align",
    "angle_between",
    "distinct",
    "evaluate",
    "fibonacci_sphere",
    "hidden",
    "load_model",
    "passes",
    "refine",
    "rotations",
]
