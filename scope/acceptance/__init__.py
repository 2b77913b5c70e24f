"""Acceptance tests by standard: a scanner against the limits that its maker states, on calibrated artefacts.

In: acceptance.toml (artefacts with their calibration, limits, scans) and those clouds.
Out: `Acceptance`: probing error of form and size, sphere spacing, flatness, position by position, each with its
    uncertainty and its decision after ISO 14253-1.
Read: standards, acceptance_file, form, readings, run, wording, page.
"""

from scope.acceptance.acceptance_file import AcceptancePlan, read_acceptance
from scope.acceptance.form import spread
from scope.acceptance.page import acceptance_page
from scope.acceptance.readings import Reading
from scope.acceptance.run import Acceptance, AcceptanceTest, accept
from scope.acceptance.standards import STANDARDS, Standard
from scope.acceptance.wording import acceptance_figures, acceptance_result, acceptance_text

__all__ = [
    "STANDARDS",
    "Acceptance",
    "AcceptancePlan",
    "AcceptanceTest",
    "Reading",
    "Standard",
    "accept",
    "acceptance_figures",
    "acceptance_page",
    "acceptance_result",
    "acceptance_text",
    "read_acceptance",
    "spread",
]
