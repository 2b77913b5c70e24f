"""Surface roughness of a patch of a scan: what is surface, what is noise, and how sure either is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.notebook import Picture, Shown, Summary, number
from scope.cloud import Mesh, Region, ScanCloud
from scope.errors import MeasurementError
from scope.heightmap import (
    DEEPEST,
    LEAST_POINTS,
    Autocorrelation,
    HeightMap,
    l_filter,
    least_s_index,
    patch_heights,
    refuse_edges,
    remove_form,
    remove_model,
    s_filter,
)
from scope.roughness.directions import ProfileSettings, direction_parameters
from scope.roughness.estimate import Estimate, MeasuredMap, estimate
from scope.roughness.gates import areal_table, trust_in_sigma
from scope.roughness.noise import SIGMA_TRUST, Noise, predicted_noise, repeat_noise
from scope.roughness.sampling import sampling_uncertainty
from scope.roughness.table import Parameter

_LARGEST_OF_PATCH = 0.2  # of the patch's shorter side: beyond, likewise
_WIDE_STRIPE = 0.02  # of Sq that its width averages away
_SMALL_PATCH = 40.0  # correlation lengths on a side, for 10 %


@dataclass(frozen=True, slots=True)
class RoughnessOptions:
    """How roughness is measured; the defaults are the standard's where it has them."""

    form: str = "auto"  # F-operator, see `scope.heightmap.form.remove_form`
    s_filter: float | None = None  # mm, areal S-filter; None: the pitch and the stripe are the only S-filter
    l_filter: float | None = None  # mm, areal L-filter and cut-off of the profiles; None: S-F surface, ISO 21920-3
    model: Mesh | None = None  # the CAD surface, in the cloud frame, in place of a form
    stripe_width: float = math.nan  # mm, one sigma of the stripe on the surface; NaN: what the cloud tells
    sigma_trust: float = SIGMA_TRUST  # relative standard uncertainty of the points' sigma
    uncertainty: bool = True  # False saves the time of it
    edges: bool = False  # True: a patch that straddles an edge is measured all the same

    def __post_init__(self) -> None:
        for name, index in (("S", self.s_filter), ("L", self.l_filter)):
            if index is not None and not 0.0 < index < math.inf:
                raise ValueError(
                    f"the {name}-filter of {index:g} mm has no length; give a nesting index in mm, or none"
                )
        if self.s_filter is not None and self.l_filter is not None and self.s_filter >= self.l_filter:
            raise ValueError(
                f"the S-filter of {self.s_filter:g} mm takes away what the L-filter of {self.l_filter:g} mm would leave; "
                "the L-filter must be the longer"
            )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Roughness(Shown):
    """Parameters of one patch."""

    areal: Mapping[str, Parameter]
    profile: Mapping[str, Mapping[str, Parameter]]  # "along" the stripe and "across" it
    noise_floor: float  # mm rms of the heights' noise, NaN where unknown
    noise_source: str  # "repeat", "sigma" or "unknown"
    valid: bool  # Sq stands: it is given, and known to better than half of itself
    pitch: tuple[float, float]  # mm between profiles, mm along them
    bandwidth: Mapping[str, float | None]  # mm: pitch, stripe width, least S-index, S, L, cut-offs, patch
    notes: tuple[str, ...]  # what a reader must know; warnings start with "warning:"
    heights: HeightMap  # what was measured, form and filters applied
    acf: Autocorrelation
    name: str = "patch"
    settings: Mapping[str, str] = field(default_factory=dict)  # form, filters, formulas, in words

    def summary(self) -> Summary:
        """Sq, Sa and Sz with their uncertainty, and the noise that was taken out."""
        figures = [(key, self.areal[key].in_words()) for key in ("Sq", "Sa", "Sz") if key in self.areal]
        figures.append(("noise", f"{number(self.noise_floor, 'mm')} by {self.noise_source}"))
        return Summary(f"Roughness of {self.name}{'' if self.valid else ', not valid'}", tuple(figures))

    def picture(self) -> tuple[Picture | None, str]:
        """The heights that were measured."""
        return self.heights.picture()

    def to_dict(self) -> dict[str, object]:
        """As it stands in JSON (docs/formats.md)."""
        return {
            "name": self.name,
            "areal": {key: value.to_dict() for key, value in self.areal.items()},
            "profile": {way: {key: p.to_dict() for key, p in table.items()} for way, table in self.profile.items()},
            "noise_floor_mm": None if math.isnan(self.noise_floor) else self.noise_floor,
            "noise_source": self.noise_source,
            "valid": self.valid,
            "pitch_mm": list(self.pitch),
            "bandwidth_mm": dict(self.bandwidth),
            "heights": int(self.heights.known.sum()),
            "gap_percent": 100.0 * self.heights.gap_share,
            "settings": dict(self.settings),
            "notes": list(self.notes),
        }


def measure_roughness(
    cloud: ScanCloud,
    *,
    region: Region | None = None,
    options: RoughnessOptions | None = None,
    noise: ScanCloud | None = None,
    name: str = "patch",
    rng: np.random.Generator | None = None,
) -> Roughness:
    """ISO parameters of a patch of a cloud, with the sensor's noise taken out where that is valid.

    Parameters
    ----------
    cloud : ScanCloud
        In scan order; its ``sigma`` predicts the noise where there is no repeat (``sigma_cal`` never does: it is shared
        by neighbours and moves no roughness).
    region : Region, optional
        The patch, in the cloud frame; the whole cloud unless told.
    options : RoughnessOptions, optional
    noise : ScanCloud, optional
        A second scan of the same surface, best displaced by more than the stripe's width.
    name : str
        Of the patch, for reports.
    rng : Generator, optional
        For the noise that is drawn to find what filters leave of it; seeded with 0 unless given.

    Raises
    ------
    MeasurementError
        No patch to measure (see `scope.heightmap.patch.patch_heights`), an edge in it, filters that do not fit it, a
        spread that no roughness has, a repeat that shows something else.
    """
    repeat = None if noise is None else patch_heights(noise, region)
    heights = patch_heights(cloud, region)
    if cloud.rig_sha256 and not cloud.verified:
        told = "warning: the rig of this cloud did not pass its verification (scope verify says why)"
        heights = replace(heights, notes=(*heights.notes, told))
    return measure_heights(heights, options=options, repeat=repeat, name=name, rng=rng)


def measure_heights(
    heights: HeightMap,
    *,
    options: RoughnessOptions | None = None,
    repeat: HeightMap | None = None,
    name: str = "patch",
    rng: np.random.Generator | None = None,
) -> Roughness:
    """Measure a height map; see `measure_roughness`. The repeat needs its ``points``, as those of a scan have."""
    options = options or RoughnessOptions()
    rng = rng or np.random.default_rng(0)
    formed = _formed(heights, options)
    width = formed.stripe_width if math.isnan(options.stripe_width) else options.stripe_width
    if repeat is None:
        known = predicted_noise(formed, trust=options.sigma_trust)
    else:
        same = replace(options, form=formed.form.split(" ")[0])
        known = repeat_noise(formed, _formed(repeat, same), stripe_width=width)
    primary, primary_noise = _filtered(formed, known, options.s_filter, None, rng)
    final, final_noise = _filtered(primary, primary_noise, None, options.l_filter, rng)
    measured = MeasuredMap.gather(final, final_noise, rng, stripe_width=width)
    found = estimate(measured)
    spread = sampling_uncertainty(measured, found, rng) if options.uncertainty else {}
    trust = trust_in_sigma(measured, found, final_noise)
    areal = areal_table(measured, found, final_noise, spread, trust, final.gap_share)
    slope_reason = areal["Sdq"].reason
    profile, told = direction_parameters(
        primary,
        primary_noise,
        cutoff=options.l_filter,
        rng=rng,
        slope_reason=slope_reason,
        with_uncertainty=options.uncertainty,
    )
    sq = areal["Sq"]
    return Roughness(
        areal=areal,
        profile=profile,
        noise_floor=final_noise.floor,
        noise_source=final_noise.source,
        valid=sq.value is not None and (sq.uncertainty or 2.0 * trust["Sq"]) < 0.5 * sq.value,
        pitch=final.pitch,
        bandwidth=_bandwidth(final, options, width, told),
        notes=(*final.notes, *final_noise.notes, *_warnings(final, found, measured), *told.notes),
        heights=final,
        acf=found.texture.acf,
        name=name,
        settings={
            "form": final.form,
            "filters": "; ".join(final.filters) or "none: S-F surface at the bandwidth of pitch and stripe",
            **told.settings,
        },
    )


def _formed(heights: HeightMap, options: RoughnessOptions) -> HeightMap:
    count = int(heights.known.sum())
    if count < LEAST_POINTS or min(heights.z.shape) < 10:
        raise MeasurementError(
            f"the patch has {count} heights on {heights.z.shape[0]} x {heights.z.shape[1]} places; {LEAST_POINTS} on at "
            "least 10 x 10 are needed: choose a larger region or scan with smaller steps"
        )
    cropped = heights.cropped()
    formed = remove_form(cropped, options.form) if options.model is None else remove_model(cropped, options.model)
    spread = float(np.nanstd(formed.z))
    limit = min(DEEPEST, _LARGEST_OF_PATCH * min(formed.size))
    if spread > limit:
        raise MeasurementError(
            f"the heights spread by {spread:.3g} mm rms about the {formed.form}, which is no roughness of a patch of "
            f"{formed.size[0]:.3g} x {formed.size[1]:.3g} mm (limit {limit:.3g} mm): check that the data are in mm and "
            "that the region is one surface"
        )
    if spread == 0.0:
        raise MeasurementError("all heights lie exactly on the form: there is no roughness in these data to measure")
    if not options.edges:
        refuse_edges(formed)
    return formed


def _filtered(
    heights: HeightMap, noise: Noise, s_index: float | None, l_index: float | None, rng: np.random.Generator
) -> tuple[HeightMap, Noise]:
    """Filter a map and, alike, its repeat; the noise floor becomes what the filters leave of it."""
    if s_index is None and l_index is None:
        return heights, noise

    def passed(map_: HeightMap) -> HeightMap:
        map_ = map_ if s_index is None else s_filter(map_, s_index)
        return map_ if l_index is None else l_filter(map_, l_index)

    result = passed(heights)
    second = None if noise.second is None else passed(heights.with_heights(noise.second)).z
    if math.isnan(noise.floor):
        return result, replace(noise, second=second)
    draw = noise.sample
    if draw is None:
        draw = np.where(heights.known, noise.floor * rng.standard_normal(heights.z.shape), np.nan)
    sample = passed(heights.with_heights(draw)).z
    return result, replace(noise, second=second, sample=sample, floor=float(np.nanstd(sample)))


def _warnings(heights: HeightMap, found: Estimate, measured: MeasuredMap) -> tuple[str, ...]:
    notes = []
    length = found.clean["Sal"]
    side = math.sqrt((heights.size[0]) * heights.size[1])
    if math.isfinite(length):
        if side < _SMALL_PATCH * length:
            notes.append(
                f"warning: the patch is {side / length:.0f} correlation lengths (Sal {length:.3g} mm) on a side; about "
                f"{_SMALL_PATCH:g} are needed for parameters that stand for the surface to 10 %"
            )
        if length < 3.0 * max(heights.pitch):
            notes.append(
                f"warning: the correlation length of {length:.3g} mm is under three pitches ({max(heights.pitch):.3g} mm): "
                "the sampling is too coarse for the finest texture"
            )
    loss = measured.stripe_loss(found.clean["Sq"])
    if loss > _WIDE_STRIPE:
        notes.append(
            f"warning: the stripe (one sigma {measured.stripe_width:.3g} mm) is wide against the texture: it averages away "
            f"up to {100.0 * loss:.1f} % of Sq, of which ranging put back {100.0 * (1.0 - measured.stripe_left):.0f} %"
        )
    if heights.gap_share > 0.5:
        notes.append(f"warning: {100.0 * heights.gap_share:.0f} % of the patch was not seen")
    return tuple(notes)


def _bandwidth(
    heights: HeightMap, options: RoughnessOptions, width: float, told: ProfileSettings
) -> dict[str, float | None]:
    return {
        "pitch_across": heights.pitch[0],
        "pitch_along": heights.pitch[1],
        "stripe_width": None if math.isnan(width) else width,
        "least_s_index": least_s_index(heights.pitch),
        "s_filter": options.s_filter,
        "l_filter": options.l_filter,
        **{f"cutoff_{way}": value for way, value in told.cutoffs.items()},
        "patch_across": heights.size[0],
        "patch_along": heights.size[1],
    }
