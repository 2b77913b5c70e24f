"""Roughness against surfalize, closed forms and realised surfaces: ``python -m benchmarks.roughness [part ...]``.

Parts: oracle, closed, gaps, noise, form. surfalize (GPL) is an oracle of the benchmark only. Every row is for
benchmarks/RESULTS.md; all seeds are fixed.
"""

from __future__ import annotations

import math
import sys
import warnings

import numpy as np
from scipy.special import ndtri

from benchmarks.roughness_surfaces import PITCH, Array, four_surfaces, random_surface, scan_of
from scope.heightmap import HeightMap, remove_form
from scope.roughness import AbbottCurve, RoughnessOptions, measure_heights, measure_roughness
from scope.roughness.abbott import core_parameters, volume_parameters
from scope.roughness.areal import height_parameters
from scope.roughness.estimate import raw_parameters

SIZE = 1000
COUPONS = 6
GROUPS = {
    "heights (Sa Sq Ssk Sku Sp Sv Sz Sxp)": ("Sa", "Sq", "Ssk", "Sku", "Sp", "Sv", "Sz", "Sxp"),
    "slopes (Sdq Sdr)": ("Sdq", "Sdr"),
    "core (Sk Spk Svk Smr1 Smr2)": ("Sk", "Spk", "Svk", "Smr1", "Smr2"),
    "volumes (Vmp Vmc Vvv Vvc)": ("Vmp", "Vmc", "Vvv", "Vvc"),
    "Sal Str": ("Sal", "Str"),
}
GOALS = (0.1, 0.1, 0.3, 0.1, 1.0)


def oracle() -> None:
    """Largest deviation from surfalize, percent, per group and surface."""
    import surfalize
    from surfalize.abbottfirestone import AbbottFirestoneCurve

    surfaces = four_surfaces(SIZE, 5)
    print(f"| against surfalize, {SIZE} x {SIZE}, largest deviation in % | goal | " + " | ".join(surfaces) + " |")
    print("| --- | --- |" + " --- |" * len(surfaces))
    found = {}
    for name, z in surfaces.items():
        ours = raw_parameters(z, PITCH).raw
        peer = surfalize.Surface(z, *PITCH)
        ordered = surfalize.Surface(np.sort(z, axis=None).reshape(z.shape), *PITCH)
        fine = AbbottFirestoneCurve(ordered, nbins=40_000)  # its own 10,000 classes move Vmp by 0.1 %
        for group, keys in GROUPS.items():
            cells = []
            for key in keys:
                coarse = getattr(peer, key)()
                theirs = (
                    getattr(fine, {"Spk": "pk", "Svk": "vk"}.get(key, key.lower()))()
                    if key[0] == "V" or key in {"Spk", "Svk"}
                    else coarse
                )
                if not math.isfinite(theirs) and not math.isfinite(ours[key]):
                    continue  # both say that it does not exist
                if abs(theirs) < 1e-3:
                    cells.append((100.0 * abs(ours[key] - theirs), key))
                else:
                    cells.append((100.0 * abs(ours[key] / theirs - 1.0), key))
            worst = max(cells)
            found[group, name] = f"{worst[0]:.3f} ({worst[1]})"
    for (group, _), goal in zip(GROUPS.items(), GOALS, strict=True):
        print(f"| {group} | {goal} | " + " | ".join(found[group, name] for name in surfaces) + " |")


def closed() -> None:
    """Gaussian of unit Sq and a sinusoid against mathematics."""
    goal = {
        "Sa": math.sqrt(2.0 / math.pi), "Sku": 3.0, "Sk": 2.57396, "Spk": 0.94503, "Svk": 0.94503, "Vmp": 0.047343,
        "Vmc": 0.905916, "Vvv": 0.111638, "Vvc": 1.217257,
    }  # fmt: skip
    quantiles = AbbottCurve.from_heights(ndtri((np.arange(1_000_000) + 0.5) / 1_000_000))
    draws = []
    rng = np.random.default_rng(1)
    for _ in range(20):
        draws.append(_distribution(AbbottCurve.from_heights(rng.standard_normal(1_000_000))))
    exact = _distribution(quantiles)
    print(
        "| Gaussian of unit Sq, 1,000,000 heights | mathematics | exact quantiles, deviation % | 20 random draws: mean deviation % | their spread % |"
    )
    print("| --- | --- | --- | --- | --- |")
    for key, value in goal.items():
        spread = np.array([draw[key] for draw in draws]) / value - 1.0
        print(
            f"| {key} | {value:.6g} | {100 * (exact[key] / value - 1):+.4f} | {100 * spread.mean():+.4f} | {100 * spread.std():.4f} |"
        )
    x = np.arange(1_000_000)
    wave = height_parameters(np.sin(2 * np.pi * x / 1000.0 + 0.1))
    print(
        f"| sinusoid: Sa / (2A/pi), Sq / (A/sqrt 2), Sku / 1.5 | 1 1 1 | {wave['Sa'] * math.pi / 2:.6f} {wave['Sq'] * math.sqrt(2):.6f} {wave['Sku'] / 1.5:.6f} | | |"
    )


def gaps() -> None:
    """Largest change, percent, when a fifth is missing."""
    rng = np.random.default_rng(2)
    print(
        "| a fifth of the heights missing, 1000 x 1000: largest change in % (parameter) | isotropic | anisotropic | ground | egg-box |"
    )
    print("| --- | --- | --- | --- | --- |")
    surfaces = four_surfaces(SIZE, 5)
    full = {name: raw_parameters(z, PITCH).raw for name, z in surfaces.items()}
    for kind in (0, 20, 60):
        cells = []
        for name, z in surfaces.items():
            part = raw_parameters(holes(z, kind, rng), PITCH).raw
            changes = [
                (100 * abs(part[k] / v - 1), k)
                for k, v in full[name].items()
                if math.isfinite(v) and k not in {"Ssk", "Std"}
            ]
            extreme = max(c for c in changes if c[1] in {"Sp", "Sv", "Sz"})
            worst = max(c for c in changes if c[1] not in {"Sp", "Sv", "Sz"})
            cells.append(
                f"{worst[0]:.2f} ({worst[1]}); Sp Sv Sz {extreme[0]:.2f}; Ssk {part['Ssk'] - full[name]['Ssk']:+.3f}"
            )
        label = "at random (goal 1, Svk of the egg-box 3, Ssk 0.01)" if kind == 0 else f"blocks of {kind} x {kind}"
        print(f"| {label} | " + " | ".join(cells) + " |")
    _coverage(surfaces, full, rng)


def _coverage(surfaces: dict[str, Array], full: dict[str, dict[str, float]], rng: np.random.Generator) -> None:
    """How often the full map's value lies within the stated k = 2 of the gappy map's."""
    cells = []
    for name, z in surfaces.items():
        inside = count = 0
        for kind in (20, 60):
            found = measure_heights(HeightMap(holes(z, kind, rng), PITCH), options=RoughnessOptions(form="none"))
            for key, value in full[name].items():
                p = found.areal[key]
                if p.value is not None and p.uncertainty is not None and math.isfinite(value):
                    count += 1
                    off = abs(p.value - value)
                    off = min(off, 180.0 - off) if key == "Std" else off  # directions of 0 and 180 degrees are one
                    inside += off <= p.uncertainty
        cells.append(f"{inside} of {count}")
    print("| blocks: parameters of the full map within the stated k = 2 | " + " | ".join(cells) + " |")


def holes(z: Array, kind: int, rng: np.random.Generator, share: float = 0.2) -> Array:
    """Heights with a share missing at random (0) or in square blocks of ``kind`` samples."""
    z = z.copy()
    if kind == 0:
        z[rng.random(z.shape) < share] = np.nan
        return z
    while np.isnan(z).mean() < share:
        i, j = (rng.integers(0, n - kind) for n in z.shape)
        z[i : i + kind, j : j + kind] = np.nan
    return z


def noise() -> None:
    """Simulated coupons: what is left after noise removal, over the realised surface."""
    print(
        "| coupon, Sq and noise 0.05 mm, over the realised heights | raw | with a repeat | sigma only | sigma 5 % too small | within stated k = 2 (repeat, sigma, wrong sigma) |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for points, length in ((160, 10.0), (400, 10.0), (400, 20.0)):
        ratios, covered = [], []
        for seed in range(COUPONS):
            rng = np.random.default_rng(1000 + seed)
            z = random_surface((points, points), length / 2.0, rng)
            truth = float(remove_form(HeightMap(z, (0.1, 0.1)), "plane").z.std())
            first, second = (scan_of(z, rng, noise=0.05, pitch=0.1) for _ in range(2))
            wrong = scan_of(z, np.random.default_rng(seed), noise=0.05, pitch=0.1, told=0.0475)
            results = [measure_roughness(first, noise=second), measure_roughness(first), measure_roughness(wrong)]
            sq = [result.areal["Sq"] for result in results]
            ratios.append([sq[0].raw / truth, *(p.value / truth for p in sq)])
            covered.append([abs(p.value - truth) <= p.uncertainty for p in sq])
        low, high = np.min(ratios, axis=0), np.max(ratios, axis=0)
        cells = " | ".join(f"{a:.3f} to {b:.3f}" for a, b in zip(low, high, strict=True))
        print(
            f"| Sq, {points} x {points}, correlation length {length:g} samples, {COUPONS} coupons | {cells} | {' '.join(f'{n}/{COUPONS}' for n in np.sum(covered, axis=0))} |"
        )
    slopes()


def slopes() -> None:
    print(f"| slopes under noise, 400 x 400, with a repeat, {COUPONS} coupons | raw Sdq | Sdq | Sdr | withheld |")
    print("| --- | --- | --- | --- | --- |")
    for length in (10.0, 20.0):
        rows, withheld, reason = [], 0, ""
        for seed in range(COUPONS):
            rng = np.random.default_rng(2000 + seed)
            z = random_surface((400, 400), length / 2.0, rng)
            truth = raw_parameters(remove_form(HeightMap(z, (0.1, 0.1)), "plane").z, (0.1, 0.1)).raw
            first, second = (scan_of(z, rng, noise=0.05, pitch=0.1) for _ in range(2))
            found = measure_roughness(first, noise=second).areal
            kept = found["Sdq"].value is not None
            withheld += not kept
            reason = found["Sdq"].reason or reason
            rows.append([
                found["Sdq"].raw / truth["Sdq"],
                found["Sdq"].value / truth["Sdq"] if kept else math.nan,
                found["Sdr"].value / truth["Sdr"] if kept else math.nan,
            ])  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            low, high = np.nanmin(rows, axis=0), np.nanmax(rows, axis=0)
        cells = " | ".join("-" if math.isnan(a) else f"{a:.3f} to {b:.3f}" for a, b in zip(low, high, strict=True))
        print(
            f"| correlation length {length:g} samples | {cells} | {withheld} of {COUPONS}{': ' + reason if reason else ''} |"
        )


def form() -> None:
    """Curved part, radius 50 mm, patch 30 mm, roughness Sq 0.05 mm along the normal."""
    side, n = 30.0, 600
    along = (np.arange(n) / (n - 1) - 0.5) * side
    x, y = np.meshgrid(along, along)
    pitch = side / (n - 1)
    forms = ("plane", "poly2", "poly6", "auto")
    print(
        "| radius 50 mm, patch 30 mm, Sq 0.05: Sq left by | "
        + " | ".join(forms)
        + " | auto chose | warning with poly6 |"
    )
    print("| --- |" + " --- |" * (len(forms) + 2))
    r = random_surface((n, n), 10.0, np.random.default_rng(3))
    for shape in ("cylinder", "sphere"):
        z = np.sqrt((50.0 + r) ** 2 - x**2 - (y**2 if shape == "sphere" else 0.0)) - 50.0
        left = {name: remove_form(HeightMap(z, (pitch, pitch)), name) for name in forms}
        cells = " | ".join(f"{left[name].z.std():.4f}" for name in forms)
        print(f"| {shape} | {cells} | {left['auto'].form} | {'yes' if left['poly6'].notes else 'no'} |")


def _distribution(curve: AbbottCurve) -> dict[str, float]:
    return {**height_parameters(curve.heights), **core_parameters(curve), **volume_parameters(curve)}


def main() -> None:
    parts = {"oracle": oracle, "closed": closed, "gaps": gaps, "noise": noise, "form": form}
    for name in sys.argv[1:] or parts:
        parts[name]()
        print()


if __name__ == "__main__":
    main()
