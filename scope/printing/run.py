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
from scope.printing.jig import Seat, jig_sheet
from scope.printing.pdf import pdf_bytes
from scope.printing.sheet import target_sheet
from scope.printing.svg import svg_text
from scope.printing.tiles import tiled
from scope.session import TEMPLATES, planned_planes, read_target, target_in
from scope.simulation import planned_session

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
        A calibration.toml, whose images need not exist yet; or a rig-design.toml, or "spots", "chessboard", "charuco", "markers" or
        "circles" for the one of `scope calibrate --init`: their calibration file is then written beside ``out``.
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
    _require(out, paper)
    text = _text_of(source)
    toml = Path(source) if text is None else out.with_suffix(".toml")
    target = read_target(toml) if text is None else _of_text(str(source), text, toml)
    try:
        sheet = target_sheet(target)
    except CalibrationError as error:
        raise CalibrationError(f"{toml}: {error}") from error
    pages = _pages(out, sheet.drawing, paper)
    stated = (sheet.across, sheet.down)
    scales = scales_of(toml, tuple(measured), stated) if measured else None
    if text is not None and not toml.exists():
        write_text(toml, text)
    pitch = correct(toml, scales, tuple(measured)) if scales is not None else None
    files = _write(pages, out, sheet.title)
    whole = sheet.drawing
    return PrintedTarget(
        sheet.title, len(target.marks), whole.width, whole.height, files, len(pages), stated, toml, scales, pitch
    )


@dataclass(frozen=True, slots=True)
class PrintedJig:
    """What was written of a jig."""

    rows: tuple[tuple[str, ...], ...]  # of its table
    files: tuple[Path, ...]
    pages: int
    across: float  # mm between the crosses

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives."""
        keys = ("name", "middle_z_mm", "from_last_mm", "x_mm", "y_mm", "z_mm", "lower_edge_y_mm")
        seats = [
            {key: cell if key == "name" else None if cell == "" else float(cell) for key, cell in zip(keys, row, strict=False)}
            | {"rotation_deg": [float(a) for a in row[-1].split(",")]}
            for row in self.rows
        ]  # fmt: skip
        return {
            "seats": seats,
            "files": [str(path) for path in self.files],
            "pages": self.pages,
            "crosses_mm": self.across,
        }


def print_jig(source: str | Path, out: str | Path, *, paper: tuple[float, float] | None = None) -> PrintedJig:
    """Draw the base of the jig that a calibration.toml or rig-design.toml describes: its stand-offs and the target's seats.

    Raises
    ------
    FileError, CalibrationError
        A file without planes of known pose, or one whose target cannot be drawn.
    ValueError
        As `print_target`.
    """
    import tempfile

    out = Path(out)
    _require(out, paper)
    text = _text_of(source)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(source)
        if text is not None:
            file = Path(folder) / "calibration.toml"
            file.write_text(text, encoding="utf-8")
        target, planes = read_target(file), planned_planes(file)
    seats = [Seat(plane.name, plane.c_from_target) for plane in planes if plane.c_from_target is not None]
    if not seats:
        raise FileError(f"{source}: no [[plane]] has an origin; views held by hand need no jig")
    try:
        sheet = jig_sheet(target, seats)
    except CalibrationError as error:
        raise CalibrationError(f"{source}: {error}") from error
    pages = _pages(out, sheet.drawing, paper)
    return PrintedJig(sheet.rows, _write(pages, out, "jig"), len(pages), sheet.across)


def _require(out: Path, paper: tuple[float, float] | None) -> None:
    ending = out.suffix.lower()
    if ending not in _ENDINGS:
        raise ValueError(f"{out}: a target is written as .svg, .pdf or .dxf")
    if paper is not None and ending == ".dxf":
        raise ValueError("a DXF is one drawing: paper is for .svg and .pdf")
    require_folder(out)


def _pages(out: Path, drawing: Drawing, paper: tuple[float, float] | None) -> list[Drawing]:
    pages = [drawing] if paper is None else tiled(drawing, paper)
    if len(pages) > _MOST_PAGES:
        raise FileError(f"{out}: {len(pages)} pages; at most {_MOST_PAGES} are written: use larger paper")
    return pages


def _text_of(source: str | Path) -> str | None:
    """calibration.toml that a kind, or a rig-design.toml, stands for; None where ``source`` is one itself."""
    import tomllib

    if str(source) in TEMPLATES:
        return TEMPLATES[str(source)]
    try:
        content = tomllib.loads(Path(source).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None  # its reader says what is wrong
    return planned_session(source)[0] if "jig" in content else None


def _of_text(source: str, text: str, toml: Path) -> Target:
    """Target of a calibration file that is to be written; ``FileError`` where another stands there."""
    import tomllib

    target = target_in(toml, tomllib.loads(text))
    if toml.exists():
        there = read_target(toml)
        if type(there) is not type(target) or there != target:
            raise FileError(
                f"{toml}: is already there and describes another target than {source!r}; name another -o, or draw that file's "
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
