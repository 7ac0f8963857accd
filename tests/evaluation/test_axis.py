"""Built axes beside true ones, and a truth carried over to a model built anew."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from railnav.errors import OffModelError
from railnav.evaluation import axis_error, truth_on
from railnav.io.geojson import read_geojson, write_geojson
from railnav.simulation import PHONE, Leg, demo_line, simulate


def test_a_truth_moves_to_a_model_built_anew():
    """On the very model it was simulated on, under another name, the truth is what it was."""
    model = demo_line(spacing=5.0)
    _, truth = simulate(model, Leg(("77R-03",), start=100.0, finish=900.0), seed=1, outfit=PHONE)
    renamed = replace(model, track_id=tuple(f"new {track}" for track in model.track_id))
    moved = truth_on(renamed, truth)
    assert moved.track_id == ("new 77R-03",)
    assert moved.simulated
    np.testing.assert_allclose(moved.offset, truth.offset, atol=2e-3)
    np.testing.assert_array_equal(moved.time, truth.time)
    with pytest.raises(OffModelError):
        truth_on(renamed, replace(truth, latitude=truth.latitude + 0.01))


def test_the_axis_of_a_model_beside_the_true_one(tmp_path):
    write_geojson(demo_line(spacing=5.0), tmp_path / "line.geojson")
    network = json.loads((tmp_path / "line.geojson").read_text(encoding="utf-8"))
    network["features"] = [f for f in network["features"] if f["properties"]["track"] in ("77R-03", "77L-10")]
    (tmp_path / "two.geojson").write_text(json.dumps(network))
    found = axis_error(read_geojson(tmp_path / "two.geojson"), demo_line(spacing=5.0))
    assert found.rms == pytest.approx(0.0, abs=1e-3)
    assert found.tunnel_max == pytest.approx(0.0, abs=1e-3)
    for feature in network["features"]:
        for vertex in feature["geometry"]["coordinates"]:
            vertex[1] += 0.5 / 111_250.0
    (tmp_path / "two.geojson").write_text(json.dumps(network))
    found = axis_error(read_geojson(tmp_path / "two.geojson"), demo_line(spacing=5.0))
    assert found.rms is not None
    assert 0.3 < found.rms < 0.5, "half a metre north, seen across a line that runs north-east"
