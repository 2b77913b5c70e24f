"""An acceptance test from its file to decisions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.errors import FileError
from scope.acceptance.acceptance_file import AcceptancePlan, Known
from scope.acceptance.readings import Reading, Seen, seen_artefact
from scope.acceptance.standards import FORMULAS, KEYS, NAMES, Key
from scope.check import Decision, decide, overall
from scope.cloud import ScanCloud, refuse_sheet
from scope.errors import MeasurementError

_SAME_MM, _SAME_DEG = 1.0, 1.0  # within which two scans show one position
_SPHERE, _BAR, _PLANE = (0.1, 0.2), 0.3, 0.5  # of the volume's diagonal; docs/method.md says how sure these are


@dataclass(frozen=True, slots=True, eq=False)
class AcceptanceTest:
    """One error of a standard at all positions."""

    key: Key
    symbol: str
    name: str
    formula: str
    readings: tuple[Reading, ...]
    uncertainty: float  # mm, k = 2, of the test value: what the artefact leaves open
    limit: float | None  # mm
    positions: int  # that differ
    needed: int | None  # None where that is not known
    decision: Decision | None  # None without a limit

    @property
    def worst(self) -> Reading:
        """The reading largest in magnitude: what the standard compares with the limit."""
        return max(self.readings, key=lambda r: abs(r.value))

    def decided(self, reading: Reading) -> Decision | None:
        """On one position."""
        return decide(reading.value, self.limit, self.uncertainty)


@dataclass(frozen=True, slots=True, eq=False)
class Acceptance:
    """A protocol: all tests, what remains to be said, and the decision."""

    plan: AcceptancePlan
    tests: tuple[AcceptanceTest, ...]
    seen: tuple[Seen, ...]
    remarks: tuple[str, ...]
    rigs: tuple[str, ...]  # SHA-256 of the rigs that the scans were made with
    verified: bool
    decision: Decision | None  # None where nothing has a limit
    why: str


def accept(plan: AcceptancePlan, *, on_scan: Callable[[int, int], None] = lambda _done, _total: None) -> Acceptance:
    """Evaluate the scans of an acceptance file.

    Every scan counts as a position of its own, unless it shows the artefact within 1 mm and 1 degree of another one. A test
    with fewer positions than the standard asks for is undecided, unless it already fails.

    Raises
    ------
    MeasurementError
        A scan without its artefact; scans of several rigs.
    """
    total, done = sum(len(a.scans) for a in plan.artefacts), 0
    seen: list[tuple[Known, Seen]] = []
    rigs: set[str] = set()
    verified = True
    for known in plan.artefacts:
        for path in known.scans:
            cloud = ScanCloud.load(path)
            refuse_sheet(cloud)
            try:
                seen.append((known, seen_artefact(path.name, cloud, known, plan.standard)))
            except MeasurementError as error:
                text = str(error).removeprefix(f"{path.name}: ")
                raise MeasurementError(
                    f"{path}: {text}; name in {plan.path.name} only scans of the {known.kind}"
                ) from error
            rigs.add(cloud.rig_sha256)
            verified = verified and cloud.verified is True
            done += 1
            on_scan(done, total)
    if len(rigs) > 1:
        raise FileError(
            f"{plan.path}: the scans are of {len(rigs)} rigs ({', '.join(sorted(r[:8] or 'unknown' for r in rigs))}); an acceptance test is of "
            "one: name its scans only"
        )
    tests = tuple(t for key in KEYS if (t := _test(plan, key, seen)) is not None)
    remarks = tuple(_remarks(plan, seen, tests))
    judged = [t.decision for t in tests if t.decision is not None]
    decision = overall(judged) if judged else None
    return Acceptance(
        plan, tests, tuple(s for _, s in seen), remarks, tuple(sorted(r for r in rigs if r)), verified, decision, _why(tests, decision)
    )  # fmt: skip


def _test(plan: AcceptancePlan, key: Key, seen: Sequence[tuple[Known, Seen]]) -> AcceptanceTest | None:
    mine = [(k, s, r) for k, s in seen for r in s.readings if r.key == key]
    if not mine:
        return None
    known = mine[0][0]
    sigma = known.form_sigma if key in {"probing_form", "flatness"} else known.size_sigma
    limit = plan.limits.get(key)
    readings = tuple(r for _, _, r in mine)
    positions = _different([s for _, s, _ in mine])
    needed = known.positions if known.positions is not None else plan.standard.positions[key]
    decision = None
    if limit is not None:
        decision = overall([d for r in readings if (d := decide(r.value, limit, 2.0 * sigma)) is not None])
        if decision == "pass" and needed is not None and positions < needed:
            decision = "undecided"
    return AcceptanceTest(
        key, plan.standard.symbols[key], NAMES[key], FORMULAS[key], readings, 2.0 * sigma, limit, positions, needed, decision
    )  # fmt: skip


def _different(seen: Sequence[Seen]) -> int:
    """Positions that differ by more than 1 mm or 1 degree from all before."""
    kept: list[Seen] = []
    for s in seen:
        if not any(_same(s, other) for other in kept):
            kept.append(s)
    return len(kept)


def _same(a: Seen, b: Seen) -> bool:
    turned = 1.0 if not a.direction.any() else abs(float(a.direction @ b.direction))
    return bool(np.linalg.norm(a.place - b.place) < _SAME_MM and turned > np.cos(np.deg2rad(_SAME_DEG)))


def _remarks(plan: AcceptancePlan, seen: Sequence[tuple[Known, Seen]], tests: Sequence[AcceptanceTest]) -> list[str]:
    found: list[str] = []
    for test in tests:
        if test.needed is not None and test.positions < test.needed:
            found.append(f"{test.symbol}: {test.positions} different positions, {test.needed} are asked for: scan the artefact at {test.needed - test.positions} more")  # fmt: skip
        elif test.needed is None:
            found.append(f"{test.symbol}: how many positions {plan.standard.title} asks for is not known to SCOPE; state it as positions = ...")  # fmt: skip
        if test.uncertainty == 0.0:
            found.append(f"{test.symbol}: the artefact's own form is not stated (form, form_uncertainty), so that the test counts as exact")  # fmt: skip
        if test.limit is not None and test.uncertainty > test.limit / 3.0:
            found.append(f"{test.symbol}: the artefact leaves {test.uncertainty:.4f} mm open (k = 2), more than a third of the limit of {test.limit:g} mm: take a better one")  # fmt: skip
    if not plan.standard.proportions:
        return found
    if plan.diagonal is None:
        return [*found, "volume is not stated: whether the artefacts are large enough for it was not looked at"]
    for known in plan.artefacts:
        mine = [s for k, s in seen if k is known]
        if known.kind == "plane":
            longest = max(s.length for s in mine)
            if longest < _PLANE * plan.diagonal:
                found.append(f"the plane was seen over {longest:.0f} mm; {_PLANE * plan.diagonal:.0f} (half of the volume's diagonal) are usual")  # fmt: skip
            continue
        low, high = (f * plan.diagonal for f in _SPHERE)
        if any(not 0.95 * low <= d <= 1.05 * high for d in known.diameters):
            found.append(f"{known.kind}: spheres of {'and '.join(f'{d:g} ' for d in known.diameters)}mm; {low:.0f} to {high:.0f} (0.1 to 0.2 of the volume's diagonal) are usual")  # fmt: skip
        if known.kind == "ball_bar" and known.size < _BAR * plan.diagonal:
            found.append(f"the ball bar's {known.size:.0f} mm are less than the usual 0.3 of the volume's diagonal, {_BAR * plan.diagonal:.0f} mm")  # fmt: skip
    return found


def _why(tests: Sequence[AcceptanceTest], decision: Decision | None) -> str:
    if decision is None:
        return "no limit is stated in [limits]: the errors are told, nothing is decided"
    judged = [t for t in tests if t.decision is not None]
    if decision == "pass":
        return f"all {len(judged)} errors stay within their limits by more than the uncertainty of the test (k = 2)"
    first = next(t for t in judged if t.decision == decision)
    worst = first.worst
    told = f"{first.symbol} = {worst.value:+.4f} mm ({worst.scan}), U {first.uncertainty:.4f} (k = 2), limit {first.limit:g}"
    if decision == "undecided" and first.needed is not None and first.positions < first.needed:
        told += f"; {first.positions} of {first.needed} positions"
    return told
