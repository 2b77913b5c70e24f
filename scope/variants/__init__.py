"""Is it this part, or its next size? The directions in which parts come in variants, tested on a scan at its best pose.

In: a scan of a part at its best pose, the `Model`, and by how much the part may differ from it.
Out: `Variant`: what differs, by how much and how sure that is; and what the scan cannot decide.
Read: edges, hypotheses, system, misfits, variant, judgement.
"""

from scope.variants.edges import Rims, Sight, rims_of
from scope.variants.judgement import MIRROR, judge
from scope.variants.system import Evidence
from scope.variants.variant import Undecided, Variant

__all__ = ["MIRROR", "Evidence", "Rims", "Sight", "Undecided", "Variant", "judge", "rims_of"]
