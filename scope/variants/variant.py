"""How a part differs from its mesh, and what a scan cannot tell, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array
from scope.variants.hypotheses import Hypothesis
from scope.variants.system import Evidence, Fitted


@dataclass(frozen=True, slots=True, eq=False)
class Variant:
    """How the scanned part differs from the mesh."""

    kind: str  # "scale", "dimension", "diameter", "hole", "boss", "missing", "extra", "mirrored"
    size: float  # % for the scale, mm else; NaN for the mirror image
    standard_error: float  # in the same unit
    unit: str  # "%" or "mm"
    text: str  # the sentence
    at: Array | None  # (3,) mm, model frame; None where it is everywhere
    alternatives: tuple[str, ...] = ()  # what explains the scan about as well


@dataclass(frozen=True, slots=True, eq=False)
class Undecided:
    """A variant that would look the same in this scan."""

    kind: str
    what: str
    look_from: Array  # (3,) unit, cloud frame: where a camera would have to be; NaN where nowhere in particular

    @property
    def text(self) -> str:
        """One line."""
        if not np.isfinite(self.look_from).all():
            return self.what
        return f"{self.what}; look from ({', '.join(f'{x:.2f}' for x in self.look_from)}) of the cloud"


def _digits(error: float) -> int:
    """Decimals that show two figures of a standard error."""
    return int(np.clip(1 - np.floor(np.log10(max(error, 1e-4))), 0, 4))


def named(h: Hypothesis, fit: Fitted, error: float) -> Variant:
    """A hypothesis with its size and standard error, in words."""
    size, n = float(fit.size[0]), _digits(error)
    if h.kind == "scale":
        word, n = "smaller" if size < 0 else "larger", _digits(100 * error)
        text = f"the scan is {abs(100 * size):.{n}f} +- {100 * error:.{n}f} % {word} than the mesh"
        return Variant("scale", 100 * size, 100 * error, "%", text, None)
    if h.kind in ("stretch", "dimension"):
        text = f"{h.name} is {h.nominal + size:.{n}f} +- {error:.{n}f} mm in the scan ({size:+.{n}f} mm)"
        return Variant("dimension", size, error, "mm", text, h.at)
    if h.kind == "diameter":
        text = f"{h.name} has a diameter of {h.nominal + size:.{n}f} +- {error:.{n}f} mm in the scan"
        return Variant("diameter", size, error, "mm", text, h.at)
    shift = h.axes.T @ fit.size
    length = float(np.linalg.norm(shift))
    told = ", ".join(f"{x:+.{n}f}" for x in shift + 0.0)
    text = f"{h.name} is {length:.{n}f} +- {error:.{n}f} mm away from its place, by ({told})"
    return Variant(h.kind, length, error, "mm", text, h.at)


def unknown_of(evidence: Evidence, each: list[tuple[Hypothesis, Fitted]]) -> tuple[Undecided, ...]:
    """Variants that are known worse than the tolerance here, each dimension once."""
    found: list[Undecided] = []
    named: set[tuple[str, float]] = set()
    for h, f in each:
        reach = evidence.model.diameter / 2 if h.kind == "scale" else 1.0
        worst = float(np.sqrt(np.linalg.eigvalsh(f.covariance).max())) * reach
        key = (str(np.round(np.abs(h.out), 2)) if h.nominal else h.name, round(h.nominal, 2))
        if worst > evidence.tolerance and key not in named:
            named.add(key)
            out = evidence.pose.rotation @ h.out if np.linalg.norm(h.out) > 0 else np.full(3, np.nan)
            what = "the size of the part as a whole" if h.kind == "scale" else h.name
            found.append(Undecided("dimension" if h.kind == "stretch" else h.kind, what, out))
    return tuple(found)
