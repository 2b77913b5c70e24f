"""Several scans in one frame: with known poses or by their shapes, joined, and compared where they overlap.

In: clouds, and their poses where these are known.
Out: `Merged`: one cloud with all columns, the pose of each, disagreement where two saw the same; or why it is not
    determined.
Read: sight, patch, overlap, search, graph, joined, run, wording.
"""

from scope.merge.overlap import PairOverlap
from scope.merge.run import Merged, merge, read_poses, write_map
from scope.merge.wording import merge_result, merge_text

__all__ = ["Merged", "PairOverlap", "merge", "merge_result", "merge_text", "read_poses", "write_map"]
