"""LandXML documents: the root, the plane and the units they name, numbers and points of their elements, names of transitions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.io.design import (
    BLOSS,
    CLOTHOID,
    COSINE,
    CUBIC,
    HELMERT,
    SINE,
    VIENNESE,
)
from railnav.io.xml_document import children as _children
from railnav.io.xml_document import local_name as _local
from railnav.io.xml_document import read_document

FloatArray = NDArray[np.float64]
SPIRALS = {
    "clothoid": CLOTHOID,
    "bloss": BLOSS,
    "cosine": COSINE,
    "sinusoid": SINE,
    "biquadratic": HELMERT,
    "wienerbogen": VIENNESE,
    "weinerbogen": VIENNESE,  # as the schema spells it
    "cubicparabola": CUBIC,
}


KNOWN = "clothoid, bloss, cosine, sinusoid (Klein), biquadratic (Helmert), wienerBogen, cubicParabola"
ANGLES = {
    "radians": 1.0,
    "grads": math.pi / 200.0,
    "decimal degrees": math.pi / 180.0,
    "decimal dd.mm.ss": math.pi / 180.0,
}


def document(path: Path) -> Any:
    """Root of the file."""
    root = read_document(path, what="LandXML", too_large="export the alignments alone, without surfaces")
    if _local(root) != "LandXML":
        raise InputError(f"is XML of the kind {_local(root)!r}, not LandXML", file=path, remedy="export LandXML 1.2")
    version = str(root.get("version", "1.2"))
    if not version.startswith("1."):
        raise InputError(f"is LandXML {version[:20]!r}", file=path, remedy="export LandXML 1.2")
    return root


def named_plane(root: Any) -> str:
    """The plane that the file names, its EPSG code or its well-known text; empty where it names none."""
    for system in _children(root, "CoordinateSystem"):
        code = str(system.get("epsgCode", "")).strip().removeprefix("EPSG:")
        if code.isdigit() and len(code) < 7:
            return f"EPSG:{code}"
        text = str(system.get("ogcWktCode", "")).strip()
        if text[:5].upper() in ("PROJC", "BOUND", "COMPO", "DERIV"):
            return text[:20_000]
    return ""


def features(node: Any) -> dict[str, str]:
    """What railnav's own writer noted where LandXML has no place."""
    return {
        str(item.get("label", "")): " ".join(str(item.get("value", "")).split())
        for feature in _children(node, "Feature")
        if feature.get("code") == "railnav"
        for item in _children(feature, "Property")
    }


def direction_unit(root: Any, path: Path) -> str:
    """Unit of directions; refuse any length but the metre."""
    unit = "radians"
    for units in _children(root, "Units"):
        for system in units:
            if _local(system) == "Imperial" or str(system.get("linearUnit", "meter")).lower() not in ("meter", "metre"):
                unit = str(system.get("linearUnit", "no metre"))[:40]
                raise InputError(f"is in {unit}", file=path, remedy="export it in metres")
            unit = str(system.get("directionUnit", unit)).lower()
            if unit not in ANGLES:
                raise InputError(
                    f"directionUnit {unit[:40]!r} is unknown", file=path, remedy=f"use {', '.join(ANGLES)}"
                )
    return unit


@dataclass(frozen=True, slots=True)
class Place:
    """Where in the file something stands, for messages."""

    path: Path
    alignment: str

    def refuse(self, node: Any, cause: str, remedy: str | None = None) -> NoReturn:
        """Raise the error for an element of the alignment."""
        what = "" if node is None else f" {_local(node)} in line {node.sourceline}"
        raise InputError(
            f"alignment {self.alignment!r},{what}: {cause}".replace(",:", ":"), file=self.path, remedy=remedy
        )

    def number(
        self,
        node: Any,
        name: str,
        *,
        default: float | None = None,
        low: float = -1e8,
        high: float = 1e8,
        infinite: bool = False,
    ) -> float:
        """A numeric attribute; INF only where it means a straight."""
        text = node.get(name)
        if text is None:
            if default is None:
                self.refuse(node, f"has no {name}", "LandXML 1.2 requires it")
            return default
        if infinite and str(text).strip().upper() in ("INF", "+INF", "-INF", "INFINITY"):
            return math.inf
        try:
            value = float(text)
        except ValueError:
            self.refuse(node, f"{name} is {str(text)[:40]!r}, not a number")
        if not low <= value <= high:  # NaN too
            self.refuse(node, f"{name} is {value:g}, not within {low:g} and {high:g}")
        return value

    def numbers(self, node: Any, least: int) -> list[float]:
        """The numbers that are an element's text."""
        try:
            values = [float(word) for word in (node.text or "").split()]
        except ValueError:
            self.refuse(node, f"holds {(node.text or '').strip()[:40]!r}, not numbers")
        if len(values) < least or not all(abs(value) < 1e9 for value in values[:3]):
            self.refuse(node, f"holds {(node.text or '').strip()[:40]!r}, not {least} coordinates")
        return values

    def point(self, node: Any, name: str) -> FloatArray:
        """Easting and northing of a point of an element, which the file has as northing easting."""
        found = _children(node, name)
        if not found:
            self.refuse(node, f"has no {name}", "LandXML 1.2 requires it")
        if found[0].get("pntRef") and not (found[0].text or "").strip():
            self.refuse(found[0], "refers to a CgPoint", "export the coordinates with the elements")
        northing, easting = self.numbers(found[0], 2)[:2]
        return np.array([easting, northing])
