"""Shared fixtures: where the real data lies, when it does."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real logs and networks; the test skips with a reason where it is absent."""
    folder = Path(os.environ.get("RAILNAV_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real data is not here ({folder}); set RAILNAV_DATA")
    return folder
