"""simulation."""

from scope.simulation.optics import exact_rays, project
from scope.simulation.rendering import expose, render_stripe, render_target
from scope.simulation.rig_design import RigDesign, read_design
from scope.simulation.session import Simulation, simulate
from scope.simulation.virtual_rig import VirtualRig

__all__ = [
    "RigDesign",
    "Simulation",
    "VirtualRig",
    "exact_rays",
    "expose",
    "project",
    "read_design",
    "render_stripe",
    "render_target",
    "simulate",
]
