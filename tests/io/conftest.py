"""Fixtures of the tests of files."""

from __future__ import annotations

import pytest
from small import make_model


@pytest.fixture
def small_model():
    return make_model()
