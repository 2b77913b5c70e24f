"""Faults named: ``python -m benchmarks.faults [real | single | oblique | narrow | two | clean | errors] [draws]``.

Nobody else names the faults of a jig, so the limit beside each figure is what was asked for. ``real`` injects faults one
at a time into the marks of the two captures beside the project; the others simulate sessions (`benchmarks.sessions`).
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.sessions import FIVE, FOUR, SEVEN, misplacement, session
from benchmarks.shared import head, require, row
from calibration.geometry import Pose
from calibration.rays import PlaneMarks, fit_ray_field
from calibration.verification import Fault, Lattice, find_faults
from calibration.verification.hypotheses import MODES_OF, Evidence, Hypothesis
from calibration.verification.redundancy import redundancy_of

KINDS = tuple(MODES_OF)
CLASS = {"pitch": "stand_off"}  # of one plane, alike up to a slip


def _class(kind: str) -> str:
    return CLASS.get(kind, kind)


@dataclass(frozen=True)
class Injected:
    """A fault put into a session."""

    plane: int
    kind: str
    size: float  # in the unit of the verdict


def draw_fault(
    rng: np.random.Generator, evidence: Evidence, plane: int, kind: str, marks: PlaneMarks, sigmas: float
) -> tuple[Injected, Pose | None, float]:
    """A fault of so many standard errors, in a random direction: the truth, the motion, the scale."""
    fit = evidence.fit((Hypothesis(plane, kind),))  # type: ignore[arg-type]
    angle = rng.uniform(0, 2 * np.pi)
    sign = float(rng.choice([-1.0, 1.0]))
    along = np.array([np.cos(angle), np.sin(angle)])
    # columns are sorted by mode: slip (x, y), rotation (x, y, turn), tilt (stand-off, x, y)
    if kind == "slip":
        size = sigmas * float(np.sqrt(along @ fit.covariance @ along))
        return Injected(plane, kind, size), misplacement(kind, size, angle, np.zeros(2)), 1.0
    if kind == "tilt":
        size = sigmas * float(np.sqrt(along @ fit.covariance[1:, 1:] @ along))
        about = marks.points.mean(axis=0)
        return Injected(plane, kind, np.degrees(size)), misplacement(kind, size, angle, about), 1.0
    size = sign * sigmas * float(np.sqrt(fit.covariance[-1, -1]))
    if kind == "pitch":
        return Injected(plane, kind, 100 * size), None, 1.0 + size
    if kind == "rotation":
        about = marks.points.min(axis=0) + rng.uniform(0, 1, 2) * np.ptp(marks.points, axis=0)
        return Injected(plane, kind, np.degrees(size)), misplacement(kind, size, 0.0, about), 1.0
    return Injected(plane, kind, size), misplacement(kind, size, 0.0, np.zeros(2)), 1.0


@dataclass(frozen=True)
class Views:
    """How sessions of one row are seen."""

    stand_offs: tuple[float, ...]
    least_oblique: float = 0.0  # rad
    most_oblique: float = 0.0
    focal_px: float = 1400.0


def drawn(
    rng: np.random.Generator, views: Views, kinds: tuple[str, ...], sigmas: float = 10.0
) -> tuple[list[PlaneMarks], list[Injected]]:
    """A session with faults of these kinds on different planes."""
    look = {
        "stand_offs": views.stand_offs,
        "oblique": rng.uniform(views.least_oblique, views.most_oblique),
        "azimuth": rng.uniform(0, 2 * np.pi),
        "focal_px": views.focal_px,
    }
    seed = int(rng.integers(2**62))
    clean = session(np.random.default_rng(seed), **look)
    test = redundancy_of(clean, fit_ray_field(clean).field)
    evidence = Evidence.of(test.score, test.information)
    planes = rng.permutation(len(clean))[: len(kinds)]
    truths, poses, scales = [], {}, {}
    for k, kind in zip(planes, kinds, strict=True):
        truth, pose, scale = draw_fault(rng, evidence, int(k), kind, clean[k], sigmas)
        truths.append(truth)
        if pose is not None:
            poses[int(k)] = pose
        scales[int(k)] = scale
    return session(np.random.default_rng(seed), **look, true_pose=poses, true_scale=scales), truths


def recognise(
    title: str, views: Views, draws: int, *, two: bool = False, seed: int = 1, limit: str = ">= 0.95"
) -> None:
    """One row a kind: how often plane and class are right."""
    for kind in KINDS:
        rng = np.random.default_rng([seed, KINDS.index(kind)])
        planes_right = right = within = alike = 0
        confusions: Counter[str] = Counter()
        for _ in range(draws):
            kinds = (kind, str(rng.choice(KINDS))) if two else (kind,)
            planes, truths = drawn(rng, views, kinds)
            found = find_faults(planes, field=fit_ray_field(planes).field)  # as the program does
            names = {planes[t.plane].name for t in truths}
            want = {(planes[t.plane].name, _class(t.kind)) for t in truths}
            got = {(f.plane, _class(f.kind)) for f in found}
            planes_right += {f.plane for f in found} == names
            right += got == want
            if got != want:
                confusions["+".join(sorted(k for _, k in got)) or "nothing"] += 1
                alike += any(f"{p}: {k}" in a for p, k in want for f in found for a in f.alternatives)
            elif not two:
                exact = [f for f in found if f.kind == kind]
                within += bool(exact) and abs(exact[0].value - truths[0].size) <= 2 * exact[0].standard_error
        share = "" if two else f"{within / max(right, 1):.3f}"
        told = ", ".join(f"{k} {n / draws:.3f}" for k, n in confusions.most_common(3))
        row(
            title,
            kind,
            f"{planes_right / draws:.3f}",
            f"{right / draws:.3f}",
            limit,
            share,
            told,
            f"{alike / draws:.3f}",
        )


def clean(draws: int) -> None:
    """False alarms in sessions without faults: 4, 5 and 7 planes, straight and oblique, good and poor targets."""
    rng = np.random.default_rng(7)
    alarms: Counter[str] = Counter()
    for _ in range(draws):
        planes = session(
            rng,
            stand_offs=(FOUR, FIVE, SEVEN)[int(rng.integers(3))],
            oblique=rng.uniform(0, np.radians(30)),
            azimuth=rng.uniform(0, 2 * np.pi),
            noise_px=float(rng.choice([0.01, 0.03])),
            target_mm=float(rng.choice([0.0, 0.02])),
            lens=(rng.uniform(-0.3, 0.05), 0.05, 4e-4, -3e-4, 0.0),
        )
        alarms.update({f.kind for f in find_faults(planes)})
    row(f"false alarms in {draws} clean sessions", sum(alarms.values()), "<= 5 in 1000", dict(alarms))


def errors(draws: int) -> None:
    """Standard errors against the scatter of the estimates, of every kind on every plane, in sessions without faults.

    The truth is nothing then, so that an estimate over its standard error has unit variance.
    """
    rng = np.random.default_rng(11)
    pulls: dict[str, list[float]] = {k: [] for k in KINDS}
    for _ in range(draws):
        planes = session(
            rng,
            stand_offs=(FOUR, FIVE, SEVEN)[int(rng.integers(3))],
            oblique=rng.uniform(0, np.radians(30)),
            azimuth=rng.uniform(0, 2 * np.pi),
        )
        test = redundancy_of(planes, fit_ray_field(planes, orders=(3, 1)).field)
        evidence = Evidence.of(test.score, test.information)
        for k in range(len(planes)):
            for kind in KINDS:
                fit = evidence.fit((Hypothesis(k, kind),))
                pulls[kind].extend(fit.amounts / np.sqrt(np.diag(fit.covariance)))
    for kind, pull in pulls.items():
        ratio = float(np.sqrt(np.mean(np.square(pull))))
        row(f"scatter over stated standard error, {kind}", f"{draws} sessions", ratio, "0.9 to 1.1")


def _seen(name: str) -> list[PlaneMarks]:
    from scope.calibrating.marks import measure_plane
    from scope.session import read_calibration

    plan = read_calibration(require(name) / "calibration.toml")
    return [measure_plane(plan, plane).marks for plane in plan.planes]


def _stated(planes: list[PlaneMarks], k: int, kind: str, size: float, angle: float) -> list[PlaneMarks]:
    """The planes, one of them stated wrong so that its truth differs by a misplacement."""
    changed = list(planes)
    motion = misplacement(kind, size, angle, planes[k].points.mean(axis=0))
    changed[k] = replace(planes[k], c_from_plane=planes[k].c_from_plane @ motion.inverse)
    return changed


def _images_of(planes: list[PlaneMarks], source: dict[int, int]) -> list[PlaneMarks]:
    return [replace(planes[source.get(k, k)], name=p.name, c_from_plane=p.c_from_plane) for k, p in enumerate(planes)]


def _mirrored(planes: list[PlaneMarks], k: int, lattice: Lattice) -> list[PlaneMarks]:
    line, column = np.divmod(planes[k].mark, lattice.columns)
    points = planes[k].points.copy()
    points[:, 0] = (lattice.columns - 1) * lattice.pitch[0] - points[:, 0]
    changed = list(planes)
    changed[k] = replace(planes[k], points=points, mark=line * lattice.columns + lattice.columns - 1 - column)
    return changed


def _verdict(title: str, runs: list[tuple[tuple[Fault, ...], set[str], str, float]]) -> None:
    """One row: right plane and class, size within two standard errors, over all planes."""
    named = sum(
        {f.plane for f in found} == planes and {_class(f.kind) for f in found} == {_class(kind)}
        for found, planes, kind, _ in runs
    )
    pulls = [abs(f.value - size) / f.standard_error for found, _, kind, size in runs for f in found if f.kind == kind]
    sized = f"{sum(p <= 2 for p in pulls)} of {len(pulls)}, worst {max(pulls):.2f}" if np.isfinite(pulls).all() else ""
    row(title, f"{named} of {len(runs)}", "all", sized)


def real() -> None:
    """Every fault of the list on every plane of the two captures."""
    head("injected, on each plane in turn", "right plane and kind", "limit", "size within 2 standard errors")
    piv, twin, lattice = _seen("piv-e"), _seen("twin-a"), Lattice(15, 21, (15.0, 15.0))
    for name, planes, grid in (("piv-e", piv, None), ("twin-a", twin, lattice)):
        row(f"{name}, nothing", f"{len(find_faults(planes, lattice=grid))} alarms", "0", "")
    cases = [
        ("piv-e, 20 um slip", piv, None, "slip", 0.02),
        ("piv-e, 0.02 deg rotation", piv, None, "rotation", np.radians(0.02)),
        ("piv-e, 0.1 mm stand-off", piv, None, "stand_off", 0.1),
        ("twin-a, 0.05 mm slip", twin, lattice, "slip", 0.05),
        ("twin-a, 0.02 deg rotation", twin, lattice, "rotation", np.radians(0.02)),
        ("twin-a, 0.2 mm stand-off", twin, lattice, "stand_off", 0.2),
    ]
    for title, planes, grid, kind, size in cases:
        runs = []
        for k, p in enumerate(planes):
            found = find_faults(_stated(planes, k, kind, size, 0.7 + k), lattice=grid)
            runs.append((found, {p.name}, kind, float(np.degrees(size)) if kind == "rotation" else size))
        _verdict(title, runs)
    nan = float("nan")
    swapped, repeated, mirrored, spots = [], [], [], []
    for k, p in enumerate(twin):
        j = (k + 1) % len(twin)
        swapped.append((find_faults(_images_of(twin, {k: j, j: k})), {p.name, twin[j].name}, "swapped", nan))
        repeated.append((find_faults(_images_of(twin, {k: j})), {p.name}, "swapped", nan))
        mirrored.append((find_faults(_mirrored(twin, k, lattice), lattice=lattice), {p.name}, "labelling", nan))
        pixels = p.pixels.copy()
        pixels[150 + k] += [0.6, 0.8]
        changed = [replace(q, pixels=pixels) if q is p else q for q in twin]
        spots.append((find_faults(changed, lattice=lattice), {p.name}, "mark", 1.0))
    _verdict("twin-a, two planes swapped", swapped)
    _verdict("twin-a, one folder of images used twice", repeated)
    _verdict("twin-a, mirrored labelling", mirrored)
    _verdict("twin-a, one spot off by 1 px", spots)


def main() -> None:
    """Run one table, or all of them."""
    which = sys.argv[1] if len(sys.argv) > 1 else "all"
    draws = int(sys.argv[2]) if len(sys.argv) > 2 else 500
    if which in {"real", "all"}:
        real()
    recognised = {
        "single": ("single, four planes, on axis", Views(FOUR)),
        "oblique": ("single, four planes, to 30 deg off the normal", Views(FOUR, 0.0, np.radians(30))),
        "far": ("single, four planes, 30 to 45 deg", Views(FOUR, np.radians(30), np.radians(45))),
        "narrow": ("single, four planes, half the field of view", Views(FOUR, 0.0, np.radians(30), 2800.0)),
        "two": ("two of seven planes, to 30 deg", Views(SEVEN, 0.0, np.radians(30))),
    }
    if which in recognised or which == "all":
        head(
            "faults of 10 standard errors",
            "kind",
            "plane",
            "plane and class",
            "limit",
            "size within 2 s.e.",
            "else",
            "named as alike",
        )
        for name, (title, views) in recognised.items():
            if which in {name, "all"}:
                recognise(title, views, draws, two=name == "two")
    if which in {"clean", "all"}:
        head("clean", "alarms", "limit", "kinds")
        clean(2 * draws)
    if which in {"errors", "all"}:
        head("standard errors", "n", "ratio", "limit")
        errors(4 * draws)


if __name__ == "__main__":
    main()
