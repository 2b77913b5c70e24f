"""scope.check."""

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
