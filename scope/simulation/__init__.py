"""The witness: a rig with known truth rendered to images; it shares no code with what it judges.

In: rig-design.toml.
Out: sessions as people record them (calibration.toml, capture.toml, images) and the truth beside them.
Read: rig_design, hardware_design, object_design, virtual_rig, refusals, physics, optics, solids, rendering, stripe_truth, written,
    session; wild, wild_table, wild_design.
"""

from scope.simulation.hardware_design import FaultDesign
from scope.simulation.optics import exact_rays, project
from scope.simulation.rendering import expose, render_stripe, render_target
from scope.simulation.rig_design import RigDesign, read_any_design, read_design
from scope.simulation.session import Simulation, planned_session, simulate
from scope.simulation.virtual_rig import VirtualRig
from scope.simulation.wild import WildScene, draw_wild, write_wild
from scope.simulation.wild_design import WildDesign

__all__ = [
    "FaultDesign",
    "RigDesign",
    "Simulation",
    "VirtualRig",
    "WildDesign",
    "WildScene",
    "draw_wild",
    "exact_rays",
    "expose",
    "planned_session",
    "project",
    "read_any_design",
    "read_design",
    "render_stripe",
    "render_target",
    "simulate",
    "write_wild",
]
