"""The claims of the sources, as the table in docs/accuracy.md makes them: no bar is missed."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


def script() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "claims.py"
    spec = importlib.util.spec_from_file_location("claims", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["claims"] = module
    spec.loader.exec_module(module)
    return module


CLAIMS = script()


@pytest.mark.parametrize("claim", CLAIMS.QUICK, ids=lambda claim: claim.__name__)
def test_claim(claim) -> None:
    row = claim()
    assert row.verdict != "FAILS", f"{row.claim}: {row.measured}"
    assert row.verdict.split()[0].rstrip(":;") in ("HOLDS", "CANNOT")


@pytest.mark.slow
def test_claims_on_drives() -> None:
    for row in CLAIMS.drives():
        assert row.verdict != "FAILS", f"{row.claim}: {row.measured}"
