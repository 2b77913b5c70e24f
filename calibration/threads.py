"""How many threads libraries may take: said in the environment before they are loaded, since most of them ask only then.

OpenBLAS and OpenMP split matrices of a calibration so finely that their threads wait for each other (several times slower on a machine
that does something else, too): they get one thread unless the user says otherwise.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping

BLAS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
OTHERS = ("NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")  # all cores unless told
OPENMP = "OMP_NUM_THREADS"
OWN = "SCOPE_THREADS"  # of SCOPE's own: decoding ahead, rays on a mesh
MOST = 1024


def claim_threads(threads: int | None, environment: MutableMapping[str, str]) -> None:
    """Write into an environment how many threads every library may take.

    None: one for OpenMP and BLAS where the user has not set them, and nothing for the others. ``ValueError`` for a number that is not 1 to 1024.
    """
    if threads is None:
        usual = environment.setdefault(OPENMP, "1")
        for name in BLAS:
            environment.setdefault(name, usual)
        return
    if not 1 <= threads <= MOST:
        raise ValueError(f"--threads {threads} is not a count from 1 to {MOST}")
    for name in (*BLAS, *OTHERS, OPENMP, OWN):
        environment[name] = str(threads)


def own_threads(usual: int) -> int:
    """Threads that SCOPE itself may take: those that were asked for, else ``usual``."""
    told = os.environ.get(OWN, "")
    return min(int(told), MOST) if told.isdecimal() and int(told) > 0 else usual
