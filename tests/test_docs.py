"""The pages of docs/: every reason and fault has its place, every command line is one, every page is in the site."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest
import typer.main

from calibration.reason import Reason
from cli.main import app

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))
import docs_commands  # noqa: E402  (a script beside the packages)

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
KINDS = ("slip", "rotation", "stand_off", "tilt", "pitch", "swapped", "labelling", "mark", "moved")


def test_every_reason_and_every_fault_has_its_place() -> None:
    text = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    headings = set(re.findall(r"^### (\w+)$", text, re.MULTILINE))
    assert headings == {reason.key for reason in Reason if reason is not Reason.RANGED} | set(KINDS)
    formats = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    assert "Kinds: " + ", ".join(f"`{kind}`" for kind in KINDS) in formats


def test_every_command_line_is_run_or_says_why_not() -> None:
    """.ci/run runs them (scripts/docs_commands.py); what needs a camera or the network says so above its block."""
    lines = [line for page in (PAGES[0], *PAGES[2:]) for line in docs_commands.lines_of(page)]
    run = [line for line in lines if not line.reason]
    assert len(run) > 25
    assert {line.text.split()[0] for line in run} == {"scope"}
    assert {line.reason for line in lines} <= {"", "needs the network", "needs a camera", ".ci/run does it, in a clone"}
    assert "docs_commands.py" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def command_lines(page: Path) -> list[str]:
    blocks = re.findall(r"```(?:sh|console)\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line.removeprefix("$ ").strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("scope ")]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_command_line_is_one(page: Path) -> None:
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    wrong = []
    for line in command_lines(page):
        words = shlex.split(line, comments=True)[1:]
        known = commands.get(words[0])
        if known is None:
            wrong.append(line)
            continue
        options = {name for parameter in known.params for name in (*parameter.opts, *parameter.secondary_opts)}
        asked = {word.split("=")[0] for word in words[1:] if re.match(r"--?[a-zA-Z]", word)}
        wrong += [f"{line}: {option}" for option in sorted(asked - options - {"--help"})]
    assert wrong == []


def test_the_site_has_every_page() -> None:
    listed = set(re.findall(r"[\w-]+\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    assert listed == {path.name for path in (ROOT / "docs").glob("*.md")}
