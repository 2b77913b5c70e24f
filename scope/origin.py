"""Who made a result, when, with what and of what: what every page and file says of itself.

The operator is whom ``scope --operator NAME`` or the environment variable ``SCOPE_OPERATOR`` names; nobody need be named.
"""

from __future__ import annotations

import getpass
import hashlib
import os
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from calibration.rig import sha256_of
from scope.version import __version__

OPERATOR = "SCOPE_OPERATOR"
_LARGEST = 2 << 30  # bytes of frames beyond which reading them twice costs more than their digest is worth
_LONGEST = 80  # letters of a name


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a result comes from."""

    made: str  # ISO 8601
    software: str
    by: str  # account and machine
    operator: str  # empty where nobody was named
    inputs: tuple[tuple[str, str], ...]  # what it is, and its SHA-256

    @property
    def told(self) -> tuple[tuple[str, str], ...]:
        """What and value, for people; the moment and the program come from the page itself."""
        digests = tuple(("input", f"{name}, sha256 {digest[:16]}") for name, digest in self.inputs)
        return (
            tuple((what, value) for what, value in (("computed by", self.by), ("operator", self.operator)) if value)
            + digests
        )

    @property
    def lines(self) -> tuple[str, ...]:
        """The same as single lines of ASCII for the header of a file, moment and program included."""
        every = (("made", f"{self.made} by {self.software}"), *self.told)
        return tuple(
            f"{what}: {' '.join(value.split())[:160]}".encode("ascii", "replace").decode("ascii")
            for what, value in every
        )

    def as_json(self) -> dict[str, Any]:
        """What ``--json`` gives under ``origin``."""
        inputs = [{"name": name, "sha256": digest} for name, digest in self.inputs]
        return {
            "made": self.made,
            "software": self.software,
            "by": self.by,
            "operator": self.operator or None,
            "inputs": inputs,
        }


def origin_of(inputs: Iterable[Path | None] = (), *, frames: Sequence[Path] = ()) -> Origin:
    """Origin of a result that is made now.

    Parameters
    ----------
    inputs : iterable of path
        Files; those that are none (or no longer there) are left out.
    frames : sequence of path
        Many files that count as one input. Beyond 2 GB they are named without a digest.
    """
    told = [(path.name, sha256_of(path)) for path in inputs if path is not None and path.is_file()]
    if frames:
        told.append((f"{len(frames)} frames", _together(frames)))
    return Origin(
        datetime.now().astimezone().isoformat(timespec="seconds"),
        f"SCOPE {__version__}",
        _account(),
        operator(),
        tuple(told),
    )


def operator() -> str:
    """Whom ``SCOPE_OPERATOR`` names; empty for nobody."""
    return " ".join(os.environ.get(OPERATOR, "").split())[:_LONGEST]


def _together(paths: Sequence[Path]) -> str:
    """SHA-256 of names and contents; words where the files are too large to be read twice."""
    if sum(path.stat().st_size for path in paths if path.is_file()) > _LARGEST:
        return "not computed: more than 2 GB"
    digest = hashlib.sha256()
    for path in paths:
        if path.is_file():
            digest.update(f"{path.name}\0{sha256_of(path)}\n".encode())
    return digest.hexdigest()


def _account() -> str:
    try:
        return f"{getpass.getuser()}@{socket.gethostname()}"[:_LONGEST]
    except (OSError, KeyError, ImportError):  # an account without a name
        return socket.gethostname()[:_LONGEST]
