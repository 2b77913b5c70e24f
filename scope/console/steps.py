"""A calibration.toml as a list of steps: what was taken at each stand-off, whether it is good, and the verdict in the end."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from calibration.atomic import write_text
from calibration.errors import FileError, ScopeError
from scope.calibrating import DARK, LASER, REPEATS, TARGET, image_places, images_there, keep_shots, shots_of
from scope.console.folder import SessionFolder, write_toml
from scope.console.jobs import Job
from scope.console.station import Station
from scope.session import PlannedPlane, planned_planes

Light = Literal["good", "poor", "taken", "empty", "skipped"]


@dataclass(slots=True, eq=False)
class Step:
    """One stand-off."""

    name: str
    shots: dict[str, tuple[str, ...]]  # what is taken there: patterns of its images, relative to the file
    light: Light = "empty"
    told: str = "to take"
    checks: dict[str, bool] = field(default_factory=dict)  # what `--check` says, by word
    files: dict[str, int] = field(default_factory=dict)  # number of images there, by kind

    @classmethod
    def of(cls, plane: PlannedPlane) -> Step:
        """Step of a plane in the file."""
        return cls(plane.name, shots_of(plane))


class Steps:
    """Steps of the session's calibration.toml, read anew where the file has changed."""

    def __init__(self, folder: SessionFolder, *, repeats: int = REPEATS) -> None:
        self.folder, self.repeats = folder, repeats
        self._judged: dict[str, tuple[tuple[float, ...], Light, str, dict[str, bool]]] = {}

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

    def all(self, *, judge: bool = True) -> list[Step]:
        """Every step with its light; ``FileError`` where there is no calibration.toml that can be read.

        Without ``judge`` images that nobody has judged yet are only told of, which takes no time.
        """
        skipped = self.skipped()
        steps = []
        for plane in planned_planes(self.folder.calibration):
            step = Step.of(plane)
            step.files = {kind: len(self._there(patterns)) for kind, patterns in step.shots.items()}
            self._judge(step, skipped, judge=judge)
            steps.append(step)
        return steps

    def take(self, station: Station, name: str, kind: str = "") -> str:
        """Take the images of one stand-off and write them as the file asks for them; what was there before is replaced.

        ``kind`` is one of the step's shots; without it, all are taken in turn where the camera switches the (only) laser, else
        the target's. New images stand in the place of the old ones only when all of them are on the disk.
        """
        step = self._step(name)
        kinds = [kind] if kind else self.in_turn(station, step) or [TARGET]
        taken = []
        for each in kinds:
            if each not in step.shots:
                raise FileError(f"{name}: calibration.toml asks for no {each[:60]} there")
            paths = image_places(self.folder.root, step.shots[each], self.repeats)
            lit = each.startswith(LASER)
            shots = station.take(len(paths), laser=lit, plane="" if each.startswith(DARK) else name)
            keep_shots(self.folder.root, step.shots[each], [shot.image for shot in shots], paths)
            taken.append(f"{len(paths)} of the {each}")
        if name in self.skipped():
            self.skip(name, out=False)
        return f"{name}: took {', '.join(taken)}"

    @staticmethod
    def in_turn(station: Station, step: Step) -> list[str]:
        """What one click takes: all, where the camera switches the only laser or none is asked for; else nothing."""
        lasers = [kind for kind in step.shots if kind.startswith(LASER)]
        return list(step.shots) if not lasers or (station.switches_laser and len(lasers) == 1) else []

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
                return Step.of(plane)
        raise FileError("calibration.toml has no such stand-off")

    def _judge(self, step: Step, skipped: set[str], *, judge: bool) -> None:
        """Light of a step by what `scope calibrate --check` says of its images."""
        from scope.calibrating import check_plane

        if step.name in skipped:
            step.light, step.told = "skipped", "left out of the calibration"
            return
        there = self._there(step.shots[TARGET])
        if not there:
            return
        when = tuple(path.stat().st_mtime for path in there)
        known = step.name in self._judged and self._judged[step.name][0] == when
        if not known and not judge:
            step.light, step.told = "taken", "judging"
            return
        if not known:
            try:
                result = check_plane(self.folder.calibration, step.name)
            except ScopeError as error:
                self._judged[step.name] = (when, "poor", " ".join(str(error).split())[:300], {})
            else:
                good = f"{result['used']} of {result['expected']} marks"
                if result.get("repeat_px") is not None:
                    good += f", repeats move {result['repeat_px']:.3f} px"
                light: Light = "poor" if result["remedy"] else "good"
                self._judged[step.name] = (when, light, result["remedy"] or good, _checks(result))
        _, step.light, step.told, step.checks = self._judged[step.name]
        missing = [kind for kind in step.shots if not step.files[kind]]
        if missing and step.light == "good":
            step.light, step.told = "taken", f"{step.told}; still to take: {', '.join(missing)}"

    def _there(self, patterns: tuple[str, ...]) -> list[Path]:
        """Images of some patterns within the session folder."""
        return images_there(self.folder.root, patterns)


def _checks(result: dict[str, Any]) -> dict[str, bool]:
    """What the command's judgement is made of, each good or not; what it could not judge is left out."""
    found, expected, share = result["used"], result["expected"], result.get("saturated")
    checks = {f"{found} of {expected} found": f"only {found} of" not in result["remedy"]}
    if share is not None:
        clipped = "are clipped" in result["remedy"]  # by the command's own limit
        checks[f"{100 * share:.0f} % clipped" if share else "not clipped"] = not clipped
    for key, bad, good in (("blurred", "blurred", "sharp"), ("moved", "moved", "still")):
        if result.get(key) is not None:
            checks[bad if result[key] else good] = not result[key]
    return checks
