"""Several scans in one frame: with known poses or by their shapes, joined, compared where they overlap, and meshed.

In: clouds, and their poses where these are known.
Out: `Merged`: one cloud with all columns, the pose of each, disagreement where two saw the same; or why it is not
    determined.
Read: sight, patch, overlap, search, graph, joined, run, wording, reconstruction.
"""

from scope.merge.overlap import PairOverlap
from scope.merge.reconstruction import Meshed, mesh_result, mesh_text, reconstruct, require_mesh_format, save_mesh
from scope.merge.run import Merged, merge, read_poses, write_map
from scope.merge.wording import merge_result, merge_text

__all__ = [
    "Meshed",
    "mesh_result",
    "mesh_text",
    "reconstruct",
    "require_mesh_format",
    "save_mesh",
    "Merged",
    "PairOverlap",
    "merge",
    "merge_result",
    "merge_text",
    "read_poses",
    "write_map",
]
