"""A scanned part against its model: deviations, and what drawings tolerate, with uncertainty and decision.

In: a cloud, the mesh of the part, and the features that are to be measured.
Out: `Inspection`: pose, deviation map, plane distances and angles, flatness, holes, steps, each passed, failed or
    undecided (ISO 14253-1).
Read: features_file, primitives, measure, run, wording.
"""

from scope.inspection.features_file import Wanted, read_features
from scope.inspection.run import Inspection, inspect_part
from scope.inspection.wording import inspection_result, inspection_text

__all__ = ["Inspection", "Wanted", "inspect_part", "inspection_result", "inspection_text", "read_features"]
