"""A seal on a JSON object: digests of its content by section, so that an alteration is seen, and seen where.

It is no signature: whoever alters a file with intent can seal it again. It guards against damage, and against a number
that was edited by hand and forgotten.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

KEY = "seal"
_SPLIT = 2  # levels of objects that have digests of their own: camera.field, lasers.red


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Content (what JSON has) with its seal under ``seal``."""
    digests = {name: _digest(value) for name, value in _sections(content)}
    return {**content, KEY: {"algorithm": "sha256", "sections": digests, "whole": _digest(digests)}}


def altered(content: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Names of the sections that are not as they were sealed, ``seal`` for the seal itself; None where there is no seal."""
    if KEY not in content:
        return None
    seal = content[KEY]
    told = seal.get("sections") if isinstance(seal, dict) else None
    if not isinstance(told, dict) or seal.get("whole") != _digest(told) or seal.get("algorithm") != "sha256":
        return (KEY,)
    found = {name: _digest(value) for name, value in _sections(content)}
    return tuple(name for name in sorted({*told, *found}) if told.get(name) != found.get(name))


def _sections(content: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Name and value of every section, down to the second level; an object's own keys count too, so that none gets lost."""

    def walk(prefix: str, value: Any, level: int) -> Iterator[tuple[str, Any]]:
        if isinstance(value, Mapping) and value and level < _SPLIT:
            for key, item in value.items():
                yield from walk(f"{prefix}.{key}" if prefix else str(key), item, level + 1)
        else:
            yield prefix, value

    yield from walk("", {key: value for key, value in content.items() if key != KEY}, 0)


def _digest(value: Any) -> str:
    """SHA-256 of the canonical JSON: sorted keys, no white space, numbers as Python writes them."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()
