"""A calibration.toml put right by what a printer made of its target."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from calibration.atomic import write_text
from calibration.errors import FileError

_LENGTHS = ("pitch", "diameter", "fiducial_diameter", "marker")
_MARK = "# scope target --measured"
_NUMBER = r"[-+]?(?:\d[\d_]*\.?[\d_]*|\.\d+)(?:[eE][-+]?\d+)?"
_WORST = 0.05  # of the scale: more is no printer's doing


def scales_of(path: Path, measured: tuple[float, ...], stated: tuple[float, float]) -> tuple[float, float]:
    """Scale along x and y of a print whose crosses, ``stated`` mm apart, were measured.

    One measurement stands for both. ``FileError`` for more than 5 % off.
    """
    pairs = [(m, s) for m, s in zip(measured, stated, strict=False)]
    for found, should in pairs:
        if not abs(found / should - 1.0) <= _WORST:
            raise FileError(
                f"{path}: --measured {found:g}: the crosses of this target stand {should:g} mm apart, and no printer is off "
                f"by {abs(found / should - 1.0):.0%}; measure from cross to cross, in mm"
            )
    x = pairs[0][0] / pairs[0][1]
    return (x, pairs[1][0] / pairs[1][1]) if len(pairs) > 1 else (x, x)


def correct(path: Path, scales: tuple[float, float], measured: tuple[float, ...]) -> float | list[float]:
    """Multiply the lengths of [target] in a file by what the print shows; comments and all else stay.

    Returns
    -------
    float or list
        The pitch as it now stands, in the file's units; the marker's side where there is no pitch.

    Raises
    ------
    FileError
        A file that was corrected before, a target whose lengths along x and y must be one and are not, or a text that
        cannot be changed in place.
    """
    text = path.read_text(encoding="utf-8")
    wanted = tomllib.loads(text)
    table = wanted["target"]
    said = ",".join(f"{m:g}" for m in measured)
    if _MARK in text:
        raise FileError(
            f"{path}: was corrected by --measured before; put the lengths of the drawing back and remove its comment "
            f"({_MARK} ...) to correct it again"
        )
    both = scales[0] != scales[1]
    if both and table["kind"] in ("charuco", "circles", "markers"):
        raise FileError(
            f"{path}: the print is {scales[0]:.5f} of its size across and {scales[1]:.5f} down, and {table['kind']} has one "
            "length for both; print it again, or use spots or a chessboard"
        )
    mean = (scales[0] + scales[1]) / 2
    if "pitch" in table:
        pitch = table["pitch"]
        each = pitch if isinstance(pitch, list) else [pitch, pitch]
        each = [_round(p * s) for p, s in zip(each, scales, strict=True)]
        table["pitch"] = each if both or isinstance(pitch, list) else each[0]
    for key in _LENGTHS[1:]:
        if key in table:
            table[key] = _round(table[key] * mean)
    for place in table.get("places", []):
        place |= {"x": _round(place["x"] * scales[0]), "y": _round(place["y"] * scales[1])}
    changed = _changed(text, table, said)
    if tomllib.loads(changed) != wanted:
        raise FileError(
            f"{path}: [target] could not be changed in place; write pitch = {table.get('pitch', table.get('marker'))} there"
        )
    write_text(path, changed)
    return table["pitch"] if "pitch" in table else float(table["marker"])


def _round(value: float) -> float:
    return round(float(value), 6)


def _changed(text: str, table: dict[str, Any], said: str) -> str:
    """Text with the values of ``table`` in its [target]."""
    found = re.search(r"^\[target\][^\n]*\n(.*?)(?=^\[|\Z)", text, flags=re.MULTILINE | re.DOTALL)
    if found is None:
        return text
    body = found.group(1)
    for key in _LENGTHS:
        if key in table:
            value = str(table[key])
            body = re.sub(rf"^(\s*{key}\s*=\s*)(?:\[[^\]]*\]|{_NUMBER})", rf"\g<1>{value}", body, flags=re.MULTILINE)
    for key in ("x", "y"):
        values = iter([str(place[key]) for place in table.get("places", [])])
        body = re.sub(rf"([{{,]\s*{key}\s*=\s*){_NUMBER}", lambda m, v=values: m.group(1) + next(v, "0"), body)
    note = f"{_MARK} {said}: the lengths below are those of the print\n"
    return text[: found.start(1)] + note + body + text[found.end(1) :]
