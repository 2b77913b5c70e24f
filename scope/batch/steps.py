"""``scan; pose --model part.stl; check -a sphere:d=34``: what is done with each session."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

MEASURE = ("pose", "check", "roughness", "inspect")  # commands whose first argument is a cloud
_OURS = {"--json", "--quiet", "-q", "--rig", "-r", "--out", "-o", "--resume", "--report"}


@dataclass(frozen=True, slots=True)
class Step:
    """One command, without its input and output."""

    label: str  # name of its columns: the command, numbered where it is there twice
    command: str
    options: tuple[str, ...]  # files in them are absolute
    files: tuple[str, ...]  # those files, for the digest

    def words(self, source: Path, rig: Path | None, cloud: Path) -> list[str]:
        """The command line after ``scope``."""
        if self.command == "scan":
            return ["scan", str(source), "--rig", str(rig), "--out", str(cloud), *self.options, "--json", "--quiet"]
        return [self.command, str(cloud), *self.options, "--json", "--quiet"]


def parse_steps(text: str) -> tuple[Step, ...]:
    """Steps of a text, separated by semicolons.

    Raises
    ------
    ValueError
        No step, a command that measures no cloud, a scan that is not the first, or an option that batch gives itself.
    """
    steps: list[Step] = []
    for part in text.split(";"):
        try:
            words = shlex.split(part)
        except ValueError as error:
            raise ValueError(f"--do {part.strip()!r}: {error}") from error
        if not words:
            continue
        command, options = words[0], words[1:]
        if command != "scan" and command not in MEASURE:
            raise ValueError(f"--do {command!r}: the steps are scan, then {', '.join(MEASURE)}")
        if command == "scan" and steps:
            raise ValueError("--do: scan is the first step or none")
        for option in options:
            if option.split("=")[0] in _OURS:
                raise ValueError(
                    f"--do {part.strip()!r}: {option.split('=')[0]} is given by batch itself; leave it away"
                )
        placed = [_absolute(option) for option in options]
        before = sum(step.command == command for step in steps)
        label = command if before == 0 else f"{command}{before + 1}"
        files = tuple(found for _, found in placed if found)
        steps.append(Step(label, command, tuple(option for option, _ in placed), files))
    if not steps:
        raise ValueError('--do: names no step; for example --do "scan; pose --model part.stl"')
    return tuple(steps)


def _absolute(word: str) -> tuple[str, str]:
    """A word whose file, whole or behind a prefix (``mesh:``, ``NAME=mesh:``, ``--model=``), is absolute; and that file."""
    for at in [0, *(k + 1 for k, letter in enumerate(word) if letter in ":=")]:
        path = Path(word[at:])
        if word[at:] and path.is_file():
            return f"{word[:at]}{path.resolve()}", str(path.resolve())
    return word, ""
