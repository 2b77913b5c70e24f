"""Time for all areal parameters of a million heights, over surfalize's: ``python -m benchmarks.roughness_speed [rounds]``.

Both in one process, in turns, best of the rounds; ours with 1 % of the heights missing, theirs without gaps, which it
refuses. Neither has anything cached: each round makes a new surface object.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from benchmarks.roughness_surfaces import PITCH, four_surfaces
from scope.roughness.estimate import raw_parameters

KEYS = (
    "Sa", "Sq", "Ssk", "Sku", "Sp", "Sv", "Sz", "Sdq", "Sdr", "Sal", "Str", "Std", "Sk", "Spk", "Svk", "Smr1", "Smr2",
    "Vmp", "Vmc", "Vvv", "Vvc", "Sxp",
)  # fmt: skip


def main() -> None:
    import warnings

    import surfalize

    warnings.simplefilter("ignore", RuntimeWarning)  # its warning that Str of a ground surface is open
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    print("| all areal parameters of 1,000,000 heights, time over surfalize's | 1 % gaps (goal 0.5) | no gaps |")
    print("| --- | --- | --- |")
    rng = np.random.default_rng(4)
    for name, z in four_surfaces(1000, 5).items():
        gappy = np.where(rng.random(z.shape) < 0.01, np.nan, z)
        times = [np.inf] * 3
        for _ in range(rounds):
            for k, work in enumerate((
                lambda gappy=gappy: raw_parameters(gappy, PITCH),
                lambda z=z: raw_parameters(z, PITCH),
                lambda z=z: [getattr(surface, key)() for surface in (surfalize.Surface(z, *PITCH),) for key in KEYS],
            )):  # fmt: skip
                start = time.perf_counter()
                work()
                times[k] = min(times[k], time.perf_counter() - start)
        print(f"| {name} | {times[0] / times[2]:.2f} | {times[1] / times[2]:.2f} |")


if __name__ == "__main__":
    main()
