"""What a scan may be asked for."""

from __future__ import annotations

from dataclasses import dataclass, field

from ranging.stripe import StripeOptions
from scope.cloud import FilterOptions


@dataclass(frozen=True, slots=True, eq=False)
class ScanOptions:
    """What a scan may be asked for."""

    stripe: StripeOptions = field(default_factory=StripeOptions)
    extrapolate: float = 0.0  # mm outside the calibrated volume that are still ranged
    max_sigma: float | None = None  # mm; points less certain than this are rejected
    normals: bool = False
    filters: FilterOptions = field(default_factory=FilterOptions)
