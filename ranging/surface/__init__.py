"""ranging.surface."""

from ranging.surface.course import REACH
from ranging.surface.edges import refine
from ranging.surface.lattice import CONTEXT, Lattice, MeasuredProfile
from ranging.surface.spacetime import Timeframe

__all__ = ["CONTEXT", "Lattice", "MeasuredProfile", "REACH", "Timeframe", "refine"]
