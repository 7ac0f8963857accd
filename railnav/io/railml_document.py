"""What a railML document is read into: net elements, and a reader that refuses by name."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.io.xml_document import local_name

FloatArray = NDArray[np.float64]
_MOST_NOTES = 20


@dataclass(slots=True)
class NetElement:
    """One net element: its points and what lies along it."""

    id: str
    node: Any
    length: float | None
    at: FloatArray  # intrinsic coordinates of the points
    point: FloatArray  # (n, 3) x, y, z (NaN without)
    measures: list[tuple[float, str, float]]  # intrinsic coordinate, system, measure
    curves: list[tuple[float, float, bool, Any]] = field(default_factory=list)
    gradients: list[tuple[float, float, bool, Any]] = field(default_factory=list)
    track: str = ""
    line: str = ""
    name: str = ""


class Reader:
    """A file being read: where things stand, for messages, and what is noted."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []

    def refuse(self, node: Any, cause: str, remedy: str | None = None) -> NoReturn:
        """Raise the error for an element."""
        name = node.get("id") or ""
        raise InputError(
            f"{local_name(node)} {name!r} in line {node.sourceline}: {cause}", file=self.path, remedy=remedy
        )

    def number(
        self, node: Any, name: str, default: float | None = None, *, low: float = -1e9, high: float = 1e9
    ) -> float:
        """A numeric attribute within bounds."""
        text = node.get(name)
        if text is None:
            if default is None:
                self.refuse(node, f"has no {name}")
            return default
        try:
            value = float(text)
        except ValueError:
            self.refuse(node, f"{name} is {str(text)[:40]!r}, not a number")
        if not low <= value <= high:
            self.refuse(node, f"{name} is {value:g}, not within {low:g} and {high:g}")
        return value

    def note(self, text: str) -> None:
        """Keep what the user should hear."""
        self.notes.append(text)

    def told(self) -> list[str]:
        """The first notes, and how many more there are."""
        left = len(self.notes) - _MOST_NOTES
        return self.notes[:_MOST_NOTES] + ([f"and {left} more"] if left > 0 else [])
