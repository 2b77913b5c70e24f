"""What each parameter is called, its unit, and where it is defined."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Definition:
    """Unit and clause of a parameter."""

    unit: str
    clause: str
    meaning: str


_AREAL = "ISO 25178-2:2021"
_PROFILE = "ISO 21920-2:2021"

AREAL = {
    "Sq": Definition("mm", f"{_AREAL}, 4.2", "root mean square height"),
    "Sa": Definition("mm", f"{_AREAL}, 4.2", "arithmetic mean height"),
    "Ssk": Definition("", f"{_AREAL}, 4.2", "skewness"),
    "Sku": Definition("", f"{_AREAL}, 4.2", "kurtosis"),
    "Sp": Definition("mm", f"{_AREAL}, 4.2", "highest peak"),
    "Sv": Definition("mm", f"{_AREAL}, 4.2", "deepest pit"),
    "Sz": Definition("mm", f"{_AREAL}, 4.2", "highest peak to deepest pit"),
    "Sz99": Definition("mm", "between material ratios 0.5 % and 99.5 %", "height that holds 99 % of the area"),
    "Sdq": Definition("", f"{_AREAL}, 4.4", "root mean square gradient"),
    "Sdr": Definition("%", f"{_AREAL}, 4.4", "developed interfacial area ratio"),
    "Sal": Definition("mm", f"{_AREAL}, 4.3", "shortest lag to a correlation of 0.2"),
    "Str": Definition("", f"{_AREAL}, 4.3", "texture aspect ratio"),
    "Std": Definition("deg", f"{_AREAL}, 4.3", "strongest direction of the spectrum; the lay is across it"),
    "Sk": Definition("mm", f"{_AREAL}, 4.5", "core height"),
    "Spk": Definition("mm", f"{_AREAL}, 4.5", "reduced peak height"),
    "Svk": Definition("mm", f"{_AREAL}, 4.5", "reduced dale depth"),
    "Smr1": Definition("%", f"{_AREAL}, 4.5", "material ratio of the hills"),
    "Smr2": Definition("%", f"{_AREAL}, 4.5", "material ratio above the dales"),
    "Sxp": Definition("mm", f"{_AREAL}, 4.5", "material ratio 2.5 % to 50 %"),
    "Vmp": Definition("mm3/mm2", f"{_AREAL}, 4.5", "peak material volume, 10 %"),
    "Vmc": Definition("mm3/mm2", f"{_AREAL}, 4.5", "core material volume, 10 % to 80 %"),
    "Vvv": Definition("mm3/mm2", f"{_AREAL}, 4.5", "dale void volume, 80 %"),
    "Vvc": Definition("mm3/mm2", f"{_AREAL}, 4.5", "core void volume, 10 % to 80 %"),
}

PROFILE = {
    "Ra": Definition("mm", f"{_PROFILE}, height parameters", "arithmetic mean height"),
    "Rq": Definition("mm", f"{_PROFILE}, height parameters", "root mean square height"),
    "Rz": Definition("mm", f"{_PROFILE}, height parameters", "maximum height, mean over the sections"),
    "Rt": Definition("mm", f"{_PROFILE}, height parameters", "total height over the evaluation length"),
    "Rsk": Definition("", f"{_PROFILE}, height parameters", "skewness"),
    "Rku": Definition("", f"{_PROFILE}, height parameters", "kurtosis"),
    "RSm": Definition("mm", f"{_PROFILE}, profile elements", "mean width of the profile elements"),
    "Rc": Definition("mm", f"{_PROFILE}, profile elements", "mean height of the profile elements"),
    "Rdq": Definition("", f"{_PROFILE}, slopes", "root mean square slope"),
    "Z2": Definition("", "Myers 1962", "root mean square slope at the stated step"),
    "JRC": Definition("", "Yu & Vayssade 1991", "joint roughness coefficient"),
    "MPD": Definition("mm", "ISO 13473-1", "mean profile depth"),
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter's value with its expanded uncertainty (k = 2), or the reason why it has none."""

    value: float | None
    uncertainty: float | None  # k = 2; None where it was not asked for or cannot be told
    unit: str
    reason: str = ""  # why the value is withheld
    raw: float | None = None  # with the noise still in it
    note: str = ""  # what the value is good for
    clause: str = ""
    at_least: bool = False  # a one-sided bound: what was not seen may only make it greater

    def in_words(self) -> str:
        """Value, uncertainty and unit; or why there is none."""
        if self.value is None:
            return f"withheld: {self.reason}"
        spread = "" if self.uncertainty is None else f" +- {self.uncertainty:.2g}"
        return f"{'at least ' if self.at_least else ''}{self.value:.4g}{spread} {self.unit}".rstrip()

    def to_dict(self) -> dict[str, float | str | None]:
        """As it stands in JSON."""
        told: dict[str, float | str | None] = {"value": self.value, "uncertainty": self.uncertainty, "unit": self.unit}
        if self.raw is not None:
            told["raw"] = self.raw
        if self.value is None:
            told["reason"] = self.reason
        if self.note:
            told["note"] = self.note
        if self.at_least:
            told["bound"] = "lower"
        return told
