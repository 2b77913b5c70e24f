"""Prints the table of rooms from the docstrings of their ``__init__``; ``--write`` puts it into CONTRIBUTING.md."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("calibration", "ranging", "scope", "cli")
PAPER = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- rooms: by scripts/rooms.py -->\n", "<!-- /rooms -->\n"


def rooms() -> list[Path]:
    """Every package, in the order in which data flows, and the rooms in it."""
    found = []
    for package in PACKAGES:
        inside = sorted(path.parent for path in (ROOT / package).glob("*/__init__.py"))
        found += [ROOT / package, *inside]
    return found


def story(room: Path) -> dict[str, str]:
    """What a room's docstring says: its title, and the paragraphs In, Out and Read, each on one line."""
    text = ast.get_docstring(ast.parse((room / "__init__.py").read_text(encoding="utf-8"))) or ""
    title, *_ = text.split("\n")
    parts = re.findall(r"^(In|Out|Read): (.*(?:\n    .*)*)", text, flags=re.MULTILINE)
    return {"title": title} | {name.lower(): re.sub(r"\s+", " ", words).strip() for name, words in parts}


def table() -> str:
    """The table of rooms in Markdown."""
    lines = ["| room | story | in | out | read in this order |", "| --- | --- | --- | --- | --- |"]
    for room in rooms():
        told = story(room)
        name = f"`{room.relative_to(ROOT).as_posix()}/`"
        lines.append(
            "| " + " | ".join([name, *(told[part].rstrip(".") for part in ("title", "in", "out", "read"))]) + " |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print, or write."""
    if sys.argv[1:] != ["--write"]:
        sys.stdout.write(table())
        return
    text = PAPER.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    PAPER.write_text(before + BEGIN + table() + END + after, encoding="utf-8")


if __name__ == "__main__":
    main()
