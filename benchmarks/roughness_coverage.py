"""How often stated uncertainties cover the truth: ``python -m benchmarks.roughness_coverage [draws] [surface ...]``.

Patches of 200 x 200 heights at 0.1 mm are cut from surfaces three times as wide, given noise and gaps, and measured; the
truth is what the same patch gives without either. A row a case: for groups of parameters the share of the answers within
their stated k = 2, and the largest and smallest bias of a mean, percent. Profile parameters of one cut-off only.
"""

from __future__ import annotations

import sys
import warnings
from collections import defaultdict

import numpy as np
from scipy.ndimage import gaussian_filter

from benchmarks.roughness import holes
from benchmarks.roughness_surfaces import Array, scan_of
from scope.heightmap import HeightMap
from scope.roughness import Roughness, RoughnessOptions, measure_heights, measure_roughness

SIDE, PITCH = 200, 0.1
MEASURED = RoughnessOptions(form="plane", edges=True)
TRUTH = RoughnessOptions(form="plane", edges=True, uncertainty=False)
# noise (mm; Sq is 0.05), how it is known, and the size of the gaps' blocks (0: single heights; None: no gaps)
CASES: tuple[tuple[float, str, int | None], ...] = (
    (0.0, "none", 20), (0.01, "sigma", 0), (0.02, "sigma", None), (0.05, "sigma", None), (0.02, "repeat", 20),
    (0.05, "repeat", 0),
)  # fmt: skip
GROUPS = {
    "Sq Sa": ("Sq", "Sa"),
    "Ssk Sku": ("Ssk", "Sku"),
    "Sp Sv Sz": ("Sp", "Sv", "Sz"),
    "Sdq Sdr": ("Sdq", "Sdr"),
    "Sal Str": ("Sal", "Str"),
    "Sk family, V family, Sxp Sz99": (
        "Sk", "Spk", "Svk", "Smr1", "Smr2", "Vmp", "Vmc", "Vvv", "Vvc", "Sxp", "Sz99",
    ),
    "Ra Rq Rsk Rku": ("Ra", "Rq", "Rsk", "Rku"),
    "Rz Rt": ("Rz", "Rt"),
    "RSm Rc": ("RSm", "Rc"),
    "Rdq Z2 JRC": ("Rdq", "Z2", "JRC"),
}  # fmt: skip


def surface(kind: str, n: int, rng: np.random.Generator) -> Array:
    """Heights (n, n) of Sq 0.05 mm."""
    white = rng.standard_normal((n, n))
    if kind == "exponential":
        frequency = np.fft.fftfreq(n)
        wave = 2.0 * np.pi * np.hypot(frequency[:, None], frequency) * 8.0
        z = np.fft.ifft2(np.fft.fft2(white) * (1.0 + wave**2) ** -0.75).real
    elif kind == "ground":
        grooves = -(np.abs(gaussian_filter(rng.standard_normal(n), 2.0, mode="wrap")) ** 1.3)
        z = grooves[None, :] + 1.5 * gaussian_filter(white, 1.5, mode="wrap")
    elif kind == "plateau":
        z = gaussian_filter(white, 4.0, mode="wrap")
        z /= z.std()
        z = np.where(z > 0.5, 0.5 + 0.2 * (z - 0.5), z)
    else:
        spread = {"isotropic": 5.0, "fine": 2.0, "anisotropic": (3.0, 9.0)}[kind]
        z = gaussian_filter(white, spread, mode="wrap")
    return np.asarray(0.05 * z / z.std())


KINDS = ("isotropic", "fine", "anisotropic", "exponential", "ground", "plateau")


def values(found: Roughness, truth: Roughness) -> dict[str, list[tuple[float, float, float]]]:
    """(found, its k = 2, true) by parameter, for what both give."""
    pairs = [(found.areal, truth.areal)]
    pairs += [
        (found.profile[way], truth.profile[way])
        for way in ("along", "across")
        if found.bandwidth[f"cutoff_{way}"] == truth.bandwidth[f"cutoff_{way}"]
    ]
    told: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for ours, theirs in pairs:
        for key, p in ours.items():
            true = theirs[key].raw if theirs[key].value is None else theirs[key].value
            if p.value is not None and p.uncertainty is not None and true is not None:
                told[key].append((p.value, p.uncertainty, true))
    return told


def case(kind: str, noise: float, source: str, gap: int | None, draws: int) -> list[str]:
    answers: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for seed in range(draws):
        rng = np.random.default_rng(5000 + seed)
        z = surface(kind, 3 * SIDE, rng)[SIDE : 2 * SIDE, SIDE : 2 * SIDE]
        truth = measure_heights(HeightMap(z, (PITCH, PITCH)), options=TRUTH)
        gappy = z if gap is None else holes(z, gap, rng)
        if noise == 0.0:
            found = measure_heights(HeightMap(gappy, (PITCH, PITCH)), options=MEASURED)
        else:
            first, second = (scan_of(z, rng, noise=noise, pitch=PITCH) for _ in range(2))
            first = first.select(np.isfinite(gappy).ravel())
            found = measure_roughness(first, noise=second if source == "repeat" else None, options=MEASURED)
        for key, one in values(found, truth).items():
            answers[key] += one
    cells = []
    for keys in GROUPS.values():
        rows = [np.array(answers[key]) for key in keys if answers[key]]
        if not rows:
            cells.append("withheld")
            continue
        inside = np.concatenate([np.abs(a[:, 0] - a[:, 2]) <= a[:, 1] for a in rows])
        biases = [
            100.0 * float(np.mean(a[:, 0] - a[:, 2])) / max(float(np.mean(np.abs(a[:, 2]))), 1e-12)
            for key, a in zip([k for k in keys if answers[k]], rows, strict=True)
            if key not in {"Ssk", "Rsk"}
        ]
        told = f"{100.0 * inside.mean():.0f} of {len(inside)}"
        cells.append(f"{told}; {min(biases):+.1f} to {max(biases):+.1f}" if biases else told)
    return cells


def main() -> None:
    warnings.simplefilter("ignore", RuntimeWarning)
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 12
    print(f"| within k = 2, % of answers; bias % ({draws} patches a case) | " + " | ".join(GROUPS) + " |")
    print("| --- |" + " --- |" * len(GROUPS))
    for kind in sys.argv[2:] or KINDS:
        for noise, source, gap in CASES:
            gaps = "no gaps" if gap is None else "20 % single" if gap == 0 else f"20 % in {gap} x {gap}"
            told = "no noise" if noise == 0.0 else f"noise {noise / 0.05:g} Sq by {source}"
            print(f"| {kind}, {told}, {gaps} | " + " | ".join(case(kind, noise, source, gap, draws)) + " |", flush=True)


if __name__ == "__main__":
    main()
