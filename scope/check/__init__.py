"""How accurate is it? A scan of something known against what is known of it.

In: a cloud and an artefact: a sphere, a cylinder, a plane, a step, a mesh.
Out: errors of size and form with their uncertainty, within tolerance or not; of a rig, its uncertainty budget and its
    certificate.
Read: artefact, shapes, decision, wording, budget, certificate.
"""

from scope.check.artefact import (
    Artefact,
    ArtefactCheck,
    Size,
    check_artefact,
    check_repeats,
    fit_artefact,
    rays_of,
    shared_of,
    write_residuals,
)
from scope.check.budget import Budget, uncertainty_budget
from scope.check.certificate import Certificate, certify
from scope.check.decision import Decision, decide, overall
from scope.check.shapes import Shape
from scope.check.wording import check_result, check_text, error_text, out_of_tolerance, repeat_result

__all__ = [
    "Artefact",
    "ArtefactCheck",
    "Budget",
    "Certificate",
    "Decision",
    "Size",
    "Shape",
    "certify",
    "check_artefact",
    "check_repeats",
    "check_result",
    "check_text",
    "error_text",
    "decide",
    "fit_artefact",
    "out_of_tolerance",
    "overall",
    "rays_of",
    "repeat_result",
    "shared_of",
    "uncertainty_budget",
    "write_residuals",
]
