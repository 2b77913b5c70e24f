"""A calibration.toml as a list of steps: what was taken at each stand-off, whether it is good, and the verdict in the end."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from calibration.atomic import write_text
from calibration.errors import FileError, ScopeError
from scope.console.folder import SessionFolder, save_image, write_toml
from scope.console.jobs import Job
from scope.console.station import Station
from scope.session import planned_planes

KINDS = ("images", "laser", "background")
Light = Literal["good", "poor", "taken", "empty", "skipped"]


@dataclass(slots=True, eq=False)
class Step:
    """One stand-off."""

    name: str
    images: tuple[str, ...]  # patterns of the target's images, relative to the file
    laser: tuple[str, ...]  # of the laser's; empty where the file asks for none, or for several lasers
    background: tuple[str, ...]
    light: Light = "empty"
    told: str = "to take"
    files: dict[str, int] = field(default_factory=dict)  # kind: number of images there


class Steps:
    """Steps of the session's calibration.toml, read anew where the file has changed."""

    def __init__(self, folder: SessionFolder, *, repeats: int = 3) -> None:
        self.folder, self.repeats = folder, repeats
        self._judged: dict[str, tuple[tuple[float, ...], Light, str]] = {}

    @property
    def _skips(self) -> Path:
        return self.folder.root / "skipped.json"

    def skipped(self) -> set[str]:
        """Names of the stand-offs that are left out."""
        try:
            told = json.loads(self._skips.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return set()
        return {str(name) for name in told} if isinstance(told, list) else set()

    def skip(self, name: str, *, out: bool) -> None:
        """Leave a stand-off out, or take it in again."""
        names = self.skipped()
        self._step(name)
        write_text(self._skips, json.dumps(sorted(names | {name} if out else names - {name})))

    def all(self) -> list[Step]:
        """Every step with its light; ``FileError`` where there is no calibration.toml that can be read."""
        skipped = self.skipped()
        steps = []
        for plane in planned_planes(self.folder.calibration):
            step = Step(plane.name, plane.images, plane.laser, plane.background)
            step.files = {kind: len(self._there(getattr(step, kind))) for kind in KINDS}
            self._judge(step, skipped)
            steps.append(step)
        return steps

    def take(self, station: Station, name: str, kind: str = "") -> str:
        """Take the images of one stand-off and write them as the file asks for them; what was there before is replaced.

        Where the camera switches the laser, target and laser are taken in turn; else ``kind`` says which: "images", "laser"
        or "background".
        """
        step = self._step(name)
        kinds = [kind] if kind else [k for k in KINDS if getattr(step, k)]
        if not kind and not station.switches_laser:
            kinds = ["images"]
        taken = []
        for each in kinds:
            if each not in KINDS or not getattr(step, each):
                raise FileError(f"{name}: calibration.toml asks for no {each} there")
            paths = self._places(getattr(step, each))
            shots = station.take(len(paths), laser=each == "laser", plane="" if each == "background" else name)
            old = set(self._there(getattr(step, each)))
            for path, shot in zip(paths, shots, strict=True):
                save_image(path, shot.image)
            for path in old - set(paths):
                path.unlink(missing_ok=True)
            taken.append(f"{len(paths)} {each}")
        if name in self.skipped():
            self.skip(name, out=False)
        return f"{name}: took {', '.join(taken)}"

    def calibrate(self, job: Job) -> dict[str, Any]:
        """Calibrate with all stand-offs that are not skipped, and write rig, page and the file that was used."""
        from scope.calibrating import calibrate
        from scope.report import calibration_page

        used = self._used_file()
        found = calibrate(used, on_plane=job.tick)
        found.rig.save(self.folder.rig)
        write_text(self.folder.root / "calibration.html", calibration_page(found))
        return {**found.result, "rig": found.rig.sha256, "report": "calibration.html"}

    def _used_file(self) -> Path:
        """calibration.toml, or where stand-offs are skipped, one without them beside it."""
        skipped = self.skipped()
        if not skipped:
            return self.folder.calibration
        content = tomllib.loads(self.folder.calibration.read_text(encoding="utf-8"))
        names = [step.name for step in self.all()]
        content["plane"] = [p for p, name in zip(content.get("plane", []), names, strict=False) if name not in skipped]
        path = self.folder.root / "calibration-used.toml"
        write_toml(path, content, f"calibration.toml without {', '.join(sorted(skipped))}, which were skipped.")
        return path

    def _step(self, name: str) -> Step:
        for plane in planned_planes(self.folder.calibration):
            if plane.name == name:
                return Step(plane.name, plane.images, plane.laser, plane.background)
        raise FileError("calibration.toml has no such stand-off")

    def _judge(self, step: Step, skipped: set[str]) -> None:
        """Light of a step by what `scope calibrate --check` says of its images."""
        from scope.calibrating import check_plane

        if step.name in skipped:
            step.light, step.told = "skipped", "left out of the calibration"
            return
        there = self._there(step.images)
        if not there:
            return
        when = tuple(path.stat().st_mtime for path in there)
        if step.name not in self._judged or self._judged[step.name][0] != when:
            try:
                result = check_plane(self.folder.calibration, step.name)
            except ScopeError as error:
                self._judged[step.name] = (when, "poor", " ".join(str(error).split())[:300])
            else:
                good = f"{result['used']} of {result['expected']} marks"
                if result.get("repeat_px") is not None:
                    good += f", repeats move {result['repeat_px']:.3f} px"
                self._judged[step.name] = (when, "poor" if result["remedy"] else "good", result["remedy"] or good)
        _, step.light, step.told = self._judged[step.name]
        if step.laser and not step.files["laser"] and step.light == "good":
            step.light, step.told = "taken", f"{step.told}; the laser's image is still to take"

    def _there(self, patterns: tuple[str, ...]) -> list[Path]:
        """Images of some patterns within the session folder."""
        for pattern in patterns:
            self._within(pattern)
        return sorted({path for pattern in patterns for path in self.folder.root.glob(pattern) if path.is_file()})

    def _places(self, patterns: tuple[str, ...]) -> list[Path]:
        """Where images go so that the patterns find them."""
        for pattern in patterns:
            self._within(pattern)
        if not any(sign in pattern for pattern in patterns for sign in "*?["):
            return [self.folder.root / pattern for pattern in patterns]
        parent, name = Path(patterns[0]).parent, Path(patterns[0]).name
        if len(patterns) > 1 or name.count("*") != 1 or any(sign in name for sign in "?[") or "*" in str(parent):
            raise FileError(
                f"calibration.toml: {patterns[0][:80]}: no new image can be named by it; write folder/*.png"
            )
        named = name if Path(name).suffix.lower() in {".png", ".tif", ".tiff", ".bmp"} else "*.png"
        return [self.folder.root / parent / named.replace("*", str(k)) for k in range(self.repeats)]

    def _within(self, pattern: str) -> None:
        if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
            raise FileError(f"calibration.toml: {pattern[:80]}: leads out of the session folder; name images inside it")
        parent = self.folder.root / Path(pattern).parent
        if not parent.resolve().is_relative_to(self.folder.root):
            raise FileError(
                f"calibration.toml: {pattern[:80]}: leads out of the session folder by a link; use a folder inside it"
            )
