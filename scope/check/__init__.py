"""How accurate is it? A scan of something known against what is known of it.

In: a cloud and an artefact: a sphere, a cylinder, a plane, a step, a mesh.
Out: errors of size and form with their uncertainty, within tolerance or not.
Read: artefact, shapes, wording.
"""

from scope.check.artefact import Artefact, ArtefactCheck, check_artefact, check_repeats
from scope.check.wording import check_result, check_text, out_of_tolerance, repeat_result

__all__ = [
    "Artefact",
    "ArtefactCheck",
    "check_artefact",
    "check_repeats",
    "check_result",
    "check_text",
    "out_of_tolerance",
    "repeat_result",
]
