"""An artefact beside the part: each scan checked by it, drift told, and what it shows of the rig's scale and tilt undone.

In: a scan with an artefact in it, the mesh of that artefact, and the rig.
Out: `Watched`: how far the artefact is off its mesh, how much the scanner stretches, and whether that is new; or a rig without it.
Read: artefact_file, strain, run, drift, stretched, correction, wording, page.
"""

from scope.watch.artefact_file import WatchPlan, read_artefact
from scope.watch.correction import Correction, correct_rig
from scope.watch.drift import Drift, drift_of
from scope.watch.page import correction_page, watch_rows
from scope.watch.run import Watched, watch
from scope.watch.strain import Strain
from scope.watch.stretched import stretched
from scope.watch.wording import correction_result, correction_text, watch_figures, watch_result, watch_text

__all__ = [
    "Correction",
    "Drift",
    "Strain",
    "WatchPlan",
    "Watched",
    "correct_rig",
    "correction_page",
    "correction_result",
    "correction_text",
    "drift_of",
    "read_artefact",
    "stretched",
    "watch",
    "watch_figures",
    "watch_result",
    "watch_rows",
    "watch_text",
]
