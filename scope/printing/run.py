"""A calibration.toml, or a kind of target, to files that are printed or machined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.atomic import require_folder, write_text, written_whole
from calibration.errors import CalibrationError, FileError
from calibration.targets import Target
from scope.printing.correction import correct, scales_of
from scope.printing.drawing import Drawing
from scope.printing.dxf import dxf_text
from scope.printing.pdf import pdf_bytes
from scope.printing.sheet import target_sheet
from scope.printing.svg import svg_text
from scope.printing.tiles import tiled
from scope.session import TEMPLATES, read_target

PAPERS = {
    "a5": (148.0, 210.0),
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}  # mm, ISO 216 and ANSI/ASME Y14.1
_ENDINGS = (".svg", ".pdf", ".dxf")
_MOST_PAGES = 200


@dataclass(frozen=True, slots=True)
class PrintedTarget:
    """What was written."""

    title: str
    marks: int
    width: float  # mm, of the whole sheet
    height: float  # mm
    files: tuple[Path, ...]
    pages: int
    crosses: tuple[float, float]  # mm between the crosses, across and down
    toml: Path  # the calibration file that describes what was drawn
    scales: tuple[float, float] | None = None  # print over drawing, along x and y, where it was measured
    pitch: Any = None  # as the file says it now, where it was corrected

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives."""
        content: dict[str, Any] = {
            "target": self.title,
            "marks": self.marks,
            "width_mm": round(self.width, 6),
            "height_mm": round(self.height, 6),
            "pages": self.pages,
            "files": [str(path) for path in self.files],
            "crosses_mm": list(self.crosses),
            "toml": str(self.toml),
        }
        return content if self.scales is None else content | {"scale": list(self.scales), "pitch": self.pitch}


def print_target(
    source: str | Path,
    out: str | Path,
    *,
    paper: tuple[float, float] | None = None,
    measured: Sequence[float] = (),
) -> PrintedTarget:
    """Draw the target that a file describes, to scale.

    Parameters
    ----------
    source : path or kind
        A calibration.toml, whose images need not exist yet; or "spots", "chessboard", "charuco", "markers" or "circles"
        for the one of `scope calibrate --init`, whose calibration file is then written beside ``out``.
    out : path
        .svg, .pdf or .dxf. An SVG of several pages becomes one file a page, numbered.
    paper : (width, height), optional
        mm, onto which the sheet is tiled; without it there is one page as large as the sheet.
    measured : up to two numbers, optional
        mm between the crosses of the print, across and down: the lengths in the calibration file are put right.

    Raises
    ------
    FileError, CalibrationError
        No target, one that cannot be drawn, a folder that is not there, a calibration file that describes another target
        where the matching one should be written.
    ValueError
        Another ending, paper for a DXF, or paper too small.
    """
    out = Path(out)
    ending = out.suffix.lower()
    if ending not in _ENDINGS:
        raise ValueError(f"{out}: a target is written as .svg, .pdf or .dxf")
    if paper is not None and ending == ".dxf":
        raise ValueError("a DXF is one drawing: paper is for .svg and .pdf")
    require_folder(out)
    kind = str(source) if str(source) in TEMPLATES else None
    toml = out.with_suffix(".toml") if kind else Path(source)
    target = _of_template(kind, toml) if kind else read_target(toml)
    try:
        sheet = target_sheet(target)
    except CalibrationError as error:
        raise CalibrationError(f"{toml}: {error}") from error
    pages = [sheet.drawing] if paper is None else tiled(sheet.drawing, paper)
    if len(pages) > _MOST_PAGES:
        raise FileError(f"{out}: {len(pages)} pages; at most {_MOST_PAGES} are written: use larger paper")
    stated = (sheet.across, sheet.down)
    scales = scales_of(toml, tuple(measured), stated) if measured else None
    if kind and not toml.exists():
        write_text(toml, TEMPLATES[kind])
    pitch = correct(toml, scales, tuple(measured)) if scales is not None else None
    files = _write(pages, out, sheet.title)
    whole = sheet.drawing
    return PrintedTarget(
        sheet.title, len(target.marks), whole.width, whole.height, files, len(pages), stated, toml, scales, pitch
    )


def _of_template(kind: str, toml: Path) -> Target:
    """Target of `scope calibrate --init`; ``FileError`` where another file stands where its own is to be."""
    import tomllib

    from scope.session import target_in

    target = target_in(toml, tomllib.loads(TEMPLATES[kind]))
    if toml.exists():
        there = read_target(toml)
        if type(there) is not type(target) or there != target:
            raise FileError(
                f"{toml}: is already there and describes another target than {kind!r}; name another -o, or draw that file's "
                f"target: scope target {toml}"
            )
    return target


def _write(pages: list[Drawing], out: Path, title: str) -> tuple[Path, ...]:
    if out.suffix.lower() == ".pdf":
        with written_whole(out) as stream:
            stream.write(pdf_bytes(pages, title))
        return (out,)
    if out.suffix.lower() == ".dxf":
        write_text(out, dxf_text(pages[0]))
        return (out,)
    digits = len(str(len(pages)))
    names = [out.with_name(f"{out.stem}-{k + 1:0{digits}d}{out.suffix}") for k in range(len(pages))]
    files = (out,) if len(pages) == 1 else tuple(names)
    for path, page in zip(files, pages, strict=True):
        write_text(path, svg_text(page, title))
    return files
