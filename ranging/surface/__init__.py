"""What neighbours know of a point: slope and edges of the surface, and the passage of the sheet over it.

In: stripes and points of the frames before and after, as a lattice of frames by lines.
Out: corrected stripe positions with their sigma, and the points that an edge has displaced.
Read: lattice, course, patches, slope, edges, spacetime.
"""

from ranging.surface.course import REACH
from ranging.surface.edges import refine
from ranging.surface.lattice import CONTEXT, Lattice, MeasuredProfile
from ranging.surface.spacetime import Timeframe

__all__ = ["CONTEXT", "Lattice", "MeasuredProfile", "REACH", "Timeframe", "refine"]
