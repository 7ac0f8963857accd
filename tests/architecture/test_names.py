"""The public names: all there, all documented, imported only when used."""

from __future__ import annotations

import inspect
import subprocess
import sys

import railnav


def test_every_public_name_exists_and_explains_itself():
    for name in railnav.__all__:
        thing = getattr(railnav, name)
        assert inspect.getdoc(thing), name


def test_importing_railnav_imports_nothing_heavy():
    code = (
        "import sys, railnav; print([m for m in ('numpy', 'numba', 'scipy', 'pyproj', 'pyarrow') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
