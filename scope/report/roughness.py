"""Roughness as a page, a table for the terminal, and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calibration.digits import rounded, two_digits
from calibration.geometry import Array
from scope.heightmap import HeightMap, local_roughness, power_spectrum
from scope.report.page import Page
from scope.roughness import AREAL, PROFILE, AbbottCurve, Definition, Parameter, Roughness
from scope.viewer import Picture, Scalar, Scene, colour_bgr, tilted

_WIDEST = 900  # px of a picture of a map


def roughness_text(patches: Sequence[Roughness]) -> str:
    """What a person reads in a terminal."""
    lines = []
    for patch in patches:
        noise = "unknown" if math.isnan(patch.noise_floor) else f"{patch.noise_floor:.3g} mm ({patch.noise_source})"
        lines.append(
            f"{patch.name}: {int(patch.heights.known.sum())} heights at {patch.pitch[0]:.3g} x {patch.pitch[1]:.3g} mm, "
            f"{100.0 * patch.heights.gap_share:.1f} % gaps; form {patch.heights.form}; noise {noise}"
        )
        for group, name, parameter in _every(patch):
            label = name if group == "areal" else f"{name} {group}"
            lines.append(f"  {label:<12} {_shown(parameter)}")
        lines += [f"  {note}" for note in patch.notes]
    return "\n".join(lines)


def roughness_csv(patches: Sequence[Roughness]) -> str:
    """One line a patch and parameter: patch, group, parameter, value, uncertainty (k = 2), unit, raw, reason, bound (lower: one-sided)."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["patch", "group", "parameter", "value", "uncertainty_k2", "unit", "raw", "reason", "bound"])
    for patch in patches:
        for group, name, p in _every(patch):
            bound = "lower" if p.at_least else ""
            cells = ["" if number is None else f"{number:.9g}" for number in (p.value, p.uncertainty, p.raw)]
            writer.writerow([patch.name, group, name, cells[0], cells[1], p.unit, cells[2], p.reason, bound])
    return stream.getvalue()


def roughness_page(patches: Sequence[Roughness], source: str) -> str:
    """One self-contained HTML page of all patches."""
    page = Page(f"Surface roughness of {source}")
    for patch in patches:
        _verdict(page, patch)
        if patch.notes and patch.notes[0].startswith("no --region"):
            page.verdict(
                "warn", f"{patch.notes[0][0].upper()}{patch.notes[0][1:]}. Name one of them to measure it alone."
            )
        _pictures(page, patch)
        _table(page, "Areal parameters (k = 2)", patch.areal, AREAL)
        for way, table in patch.profile.items():
            _table(page, f"Profile parameters {way} the stripe (k = 2)", table, PROFILE)
        page.heading("How it was measured")
        rows = [(key, value) for key, value in patch.settings.items()]
        rows += [
            (f"{key.replace('_', ' ')} (mm)", "not known" if value is None else f"{value:.4g}")
            for key, value in patch.bandwidth.items()
        ]
        page.table(("setting", "value"), rows)
        for note in patch.notes:
            page.text(note)
    return page.html()


def shaded(heights: HeightMap) -> Picture:
    """Picture (rows, columns, 3) of a map: colour for height, light from the upper left for slope; gaps dark grey."""
    z = heights.z
    colour = colour_bgr(z).astype(np.float64)
    down, along = (np.gradient(z, pitch, axis=axis) for axis, pitch in zip((0, 1), heights.pitch, strict=True))
    steepness = np.nanstd(np.hypot(down, along)) if np.isfinite(down).any() else 1.0
    light = 1.0 - np.clip((down + along) / (6.0 * max(float(steepness), 1e-12)), -0.35, 0.35)
    lit = colour * np.where(np.isfinite(light), light, 1.0)[:, :, None]
    return _square(np.clip(np.rint(lit), 0, 255).astype(np.uint8), heights.pitch)


def _relief(heights: HeightMap) -> Scene:
    """The map as points: x along the stripe, y across it, z the height, shown so much higher that it is seen."""
    row, column = np.nonzero(heights.known)
    z = heights.z[row, column]
    points = np.stack([column * heights.pitch[1], -row * heights.pitch[0], z], axis=1)
    scalars = [Scalar("height", z)]
    if heights.sigma is not None:
        scalars.append(Scalar("sigma", heights.sigma[row, column], label="sigma, noise"))
    low, high = np.percentile(z, (1, 99))
    power = 0.12 * max(heights.size) / max(float(high - low), 1e-9)
    step = 10.0 ** np.floor(np.log10(max(power, 1.0)))
    stretch = float(max(1.0, step * np.floor(power / step)))
    return Scene(points, tuple(scalars), look=tilted("z"), stretch=(1.0, 1.0, stretch))


def _square(picture: Picture, pitch: tuple[float, float]) -> Picture:
    """Picture with pixels as wide as high, at most 900 on a side."""
    import cv2

    fine = min(pitch)
    size = [n * p / fine for n, p in zip(picture.shape[1::-1], pitch[::-1], strict=True)]
    scale = min(1.0, _WIDEST / max(size)) if max(size) > _WIDEST else max(1.0, math.floor(_WIDEST / 2 / max(size)))
    wanted = (max(1, round(size[0] * scale)), max(1, round(size[1] * scale)))
    return np.asarray(cv2.resize(picture, wanted, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _verdict(page: Page, patch: Roughness) -> None:
    sq = patch.areal["Sq"]
    told = f"{patch.name}: Sq {_shown(sq)}"
    if patch.noise_source == "unknown":
        told += "; the noise of the heights is not known and still in it"
    elif sq.raw is not None:
        told += f"; {sq.raw:.4g} mm with the noise of {patch.noise_floor:.3g} mm ({patch.noise_source}) still in it"
    warned = any(note.startswith("warning") for note in patch.notes)
    page.verdict("bad" if not patch.valid else "warn" if warned else "good", told)


def _pictures(page: Page, patch: Roughness) -> None:
    heights, pitch = patch.heights, patch.pitch
    low, high = np.nanpercentile(heights.z, (2, 98))
    page.image(
        shaded(heights),
        f"Heights from {low:.3g} (dark) to {high:.3g} mm (bright), lit from the upper left; {heights.size[1]:.4g} x "
        f"{heights.size[0]:.4g} mm, the stripe runs along the rows",
    )
    page.cloud(
        _relief(heights),
        "The heights after the form was taken off, to be turned and cut; shown larger than they are",
        limit=120_000,
    )
    window = 0.15 * min(heights.size)
    local = local_roughness(heights.z, pitch, window)
    if np.isfinite(local).any():
        least, most = np.nanpercentile(local, (2, 98))
        page.image(
            _square(colour_bgr(local), pitch),
            f"Sq from place to place in windows of {window:.3g} mm: {least:.3g} (dark) to {most:.3g} mm (bright)",
        )
    row, column = (int(np.argmax(heights.known.sum(axis=1 - axis))) for axis in (0, 1))
    page.plot(
        [
            ("along the stripe", np.arange(heights.z.shape[1]) * pitch[1], heights.z[row]),
            ("across it", np.arange(heights.z.shape[0]) * pitch[0], heights.z[:, column]),
        ],
        "The most complete profile of either direction",
        x_label="position, mm",
        y_label="height, mm",
    )
    curve = AbbottCurve.from_heights(heights.z[heights.known])
    ratio, height = curve.sampled()
    page.plot([("", ratio, height)], "Material ratio (Abbott) curve", x_label="material ratio, %", y_label="height, mm")
    page.plot(
        [(name, *patch.acf.profile(axis)) for name, axis in (("along", 1), ("across", 0))],
        "Autocorrelation, noise taken out of its peak",
        x_label="lag, mm",
        y_label="correlation",
    )
    page.plot(_spectra(patch), "Power spectrum", x_label="frequency, 1/mm", y_label="density, mm3", log=True)


def _spectra(patch: Roughness) -> list[tuple[str, Array, Array]]:
    """Spectra of the profiles of both directions: the areal one summed over the other frequency."""
    density, down, along = power_spectrum(patch.acf)
    series = []
    for name, frequency, values, step in (
        ("along", along, density.sum(axis=0), down[1] - down[0]),
        ("across", down, density.sum(axis=1), along[1] - along[0]),
    ):
        positive = frequency > 0.0
        series.append((name, frequency[positive], 2.0 * step * values[positive]))
    return series


def _table(page: Page, title: str, table: Mapping[str, Parameter], definitions: Mapping[str, Definition]) -> None:
    page.heading(title)
    rows = []
    for name, p in table.items():
        value = "withheld" if p.value is None else f"{'≥ ' if p.at_least else ''}{_digits(p.value, p.uncertainty)}"
        spread = "" if p.uncertainty is None else f"± {two_digits(p.uncertainty)}"
        raw = "" if p.raw is None else _digits(p.raw, p.uncertainty)
        told = p.reason or p.note or definitions[name].meaning
        rows.append((name, value, spread, p.unit, raw, definitions[name].clause, told))
    page.table(
        ("parameter", "value", "k = 2", "unit", "with noise", "defined in", "what it is, or why it is withheld"), rows
    )


def _shown(p: Parameter) -> str:
    if p.value is None:
        return f"withheld: {p.reason}"
    spread = "" if p.uncertainty is None else f" ± {two_digits(p.uncertainty)}"
    least = "at least " if p.at_least else ""
    return f"{least}{_digits(p.value, p.uncertainty)}{spread} {p.unit}".rstrip()


def _digits(value: float, uncertainty: float | None) -> str:
    """Value to the place of its uncertainty's second digit, to four digits where it has none."""
    return f"{value:.4g}" if uncertainty is None else rounded(value, uncertainty)


def _every(patch: Roughness) -> Iterator[tuple[str, str, Parameter]]:
    for name, parameter in patch.areal.items():
        yield "areal", name, parameter
    for way, table in patch.profile.items():
        for name, parameter in table.items():
            yield way, name, parameter
