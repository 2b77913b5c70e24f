"""One answer from all evidence: calibration, verifications and checks of a rig, with its uncertainty budget."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from calibration.errors import FileError
from calibration.rig import Rig
from scope.check.budget import Budget, uncertainty_budget
from scope.cloud import ScanCloud
from scope.version import __version__

_LARGEST = 10_000_000  # bytes


@dataclass(frozen=True, slots=True)
class Evidence:
    """A result of `scope check --json` or `scope verify --json`, kept as a file."""

    name: str
    sha256: str
    kind: str  # "check" or "verification"
    good: bool
    told: str  # the figures in words
    result: dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """What is known of a rig, and whether it may be used."""

    rig: Rig
    budgets: tuple[Budget, ...]
    evidence: tuple[Evidence, ...]
    operator: str
    made: str  # ISO 8601

    @property
    def why(self) -> str:
        """Reasons why it may not be used, or what it rests on."""
        against = [] if self.rig.verification.passed else [f"the calibration did not pass: {self.rig.verification.why}"]
        against += [f"{each.name}: {each.told}" for each in self.evidence if not each.good]
        if against:
            return "; ".join(against)
        checks = sum(each.kind == "check" for each in self.evidence)
        told = f"the calibration passed; {_counted(len(self.evidence) - checks, 'verification')}, {_counted(checks, 'check')}, all good"
        return told if checks else f"{told}; no artefact was checked, so that an error of scale would not be seen"

    @property
    def passed(self) -> bool:
        """Whether calibration, verifications and checks all are good."""
        return self.rig.verification.passed and all(each.good for each in self.evidence)

    def as_json(self) -> dict[str, Any]:
        """What `scope certificate --json` gives."""
        rig = self.rig
        return {
            "passed": self.passed,
            "why": self.why,
            "made": self.made,
            "software": f"SCOPE {__version__}",
            "operator": self.operator or None,
            "rig": {
                "sha256": rig.sha256,
                "camera_id": rig.camera_id or None,
                "calibrated": rig.written or None,
                "passed": rig.verification.passed,
                "why": rig.verification.why,
                "accept": dict(rig.accept),
                "inputs": dict(rig.inputs),
            },
            "budget": [budget.as_json() for budget in self.budgets],
            "evidence": [
                {"file": e.name, "sha256": e.sha256, "kind": e.kind, "good": e.good, "told": e.told}
                for e in self.evidence
            ],
        }


def certify(
    rig: Rig,
    *,
    clouds: Sequence[ScanCloud] = (),
    results: Sequence[str | Path] = (),
    lengths_percent: float | None = None,
    operator: str = "",
) -> Certificate:
    """Join what is known of a rig.

    Parameters
    ----------
    rig : Rig
        As read from its file.
    clouds : sequence of ScanCloud
        Scans by it, for the noise of the stripe.
    results : sequence of path
        JSON files of `scope check --json` and `scope verify --json`.
    lengths_percent : float, optional
        See `uncertainty_budget`.
    operator : str, optional
        Who answers for it.

    Raises
    ------
    FileError
        A result that cannot be read or is none.
    MeasurementError, ValueError
        As `uncertainty_budget`.
    """
    budgets = uncertainty_budget(rig, clouds, lengths_percent=lengths_percent)
    made = datetime.now().astimezone().isoformat(timespec="seconds")
    return Certificate(rig, budgets, tuple(read_evidence(path) for path in results), operator, made)


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def read_evidence(path: str | Path) -> Evidence:
    """Read a result that was kept as JSON; ``FileError`` where it is none of check or verify."""
    path = Path(path)
    needed = "give what `scope check --json` or `scope verify --json` printed"
    try:
        if path.stat().st_size > _LARGEST:
            raise FileError(f"{path}: {path.stat().st_size} bytes; a result has at most {_LARGEST}: check the path")
        data = path.read_bytes()
        content = json.loads(data)
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); {needed}") from error
    except (ValueError, RecursionError) as error:
        raise FileError(f"{path}: is no JSON ({str(error)[:80]}); {needed}") from error
    digest = hashlib.sha256(data).hexdigest()
    try:
        if "error_mm" in content and "artefact" in content:
            return Evidence(path.name, digest, "check", *_of_check(content), content)
        if isinstance(content["passed"], bool) and "planes" in content and "faults" in content:
            told = str(content["why"])[:300]
            return Evidence(path.name, digest, "verification", content["passed"], told, content)
    except (KeyError, TypeError, ValueError):
        pass  # the message below says what is needed
    raise FileError(f"{path}: is no result of a check or a verification; {needed}")


def _of_check(content: dict[str, Any]) -> tuple[bool, str]:
    """Whether a check speaks for the rig, and its figures."""
    error, within, claimed = float(content["error_mm"]), content["within"], content["within_claimed_uncertainty"]
    told = f"{content['artefact']}: error {error:+.4f} mm, form {float(content['form_mm']):.4f} mm"
    if within is False:
        return False, f"{told}, out of tolerance"
    if claimed is False and within is None:
        return False, f"{told}, larger than its claimed uncertainty, and no tolerance was given"
    return True, f"{told}, {'within tolerance' if within else 'within its claimed uncertainty'}"
