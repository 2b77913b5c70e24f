"""ranging.surface."""

from ranging.surface.course import REACH
from ranging.surface.edges import refine
from ranging.surface.lattice import CONTEXT, Lattice, Seen
from ranging.surface.spacetime import Exposure

__all__ = ["CONTEXT", "Exposure", "Lattice", "REACH", "Seen", "refine"]
