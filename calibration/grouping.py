"""Many reasons told as few."""

from __future__ import annotations

import re
from collections.abc import Sequence

_LONGEST = 150  # characters of one reason


def grouped(reasons: Sequence[tuple[str, str]], total: int, what: str, *, longest: int = 240) -> str:
    """Reasons (name, why) counted by kind, commonest first, with one example each: "11 of 30 views: no board; e.g. im12".

    Reasons are of one kind where they differ in numbers only. What does not fit into ``longest`` characters is counted.
    Empty where there is none.
    """
    kinds: dict[str, list[tuple[str, str]]] = {}
    for name, why in reasons:
        kinds.setdefault(re.sub(r"[-+]?\d[\d.,]*", "#", why), []).append((name, why))
    ranked = sorted(kinds.values(), key=len, reverse=True)
    told: list[str] = []
    for k, kind in enumerate(ranked):
        name, why = kind[0]
        text = f"{len(kind)} of {total} {what}: {shortened(why)}"
        text += f"; e.g. {name}" if len(kind) > 1 else f" ({name})"
        if told and len("; ".join([*told, text])) > longest:
            rest = sum(len(other) for other in ranked[k:])
            told.append(f"{rest} more for other reasons")
            break
        told.append(text)
    return "; ".join(told)


def shortened(text: str, longest: int = _LONGEST) -> str:
    """Text cut at its first advice or, where it is still too long, at a word."""
    if len(text) > longest:
        text = text.partition(":")[0] if 20 < text.find(":") <= longest else text
    return text if len(text) <= longest else text[: longest - 3].rsplit(" ", 1)[0] + "..."
