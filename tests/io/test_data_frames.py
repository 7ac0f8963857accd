"""Models and solutions as Arrow streams and GeoDataFrames."""

from __future__ import annotations

import sys

import numpy as np
import pyarrow as pa
import pytest

import railnav
from railnav.errors import RailnavError, TrackError
from railnav.io.solution import solution_table
from railnav.track.tables import LAYERS, model_table


@pytest.fixture(scope="module")
def model():
    return railnav.demo_line()


@pytest.fixture(scope="module")
def solution(model):
    run, _ = railnav.simulate(model, ["77R-02", "77R-03"], seed=3)
    return railnav.navigate(run, model)


def test_arrow_takes_a_model_without_being_told(model):
    """pa.table() knows nothing of railnav: the protocol is enough. One row a knot, every number to the bit."""
    table = pa.table(model)
    assert table.num_rows == len(model.offset)
    np.testing.assert_array_equal(table["offset_m"].to_numpy(), model.offset)
    np.testing.assert_array_equal(table["curvature_1_m"].to_numpy(), model.curvature)
    tracks = table["track"].to_pylist()
    assert tracks[0] == model.track_id[0]
    assert tracks[-1] == model.track_id[-1]
    assert table["covariance_ee_m2"].null_count == int(np.isnan(model.covariance_g[:, 0]).sum())
    again = pa.RecordBatchReader.from_stream(model).read_all()
    assert again.schema.field("geometry").metadata[b"ARROW:extension:name"] == b"geoarrow.wkb"


@pytest.mark.parametrize("layer", LAYERS)
def test_every_layer_is_a_frame(model, layer):
    geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed (extra frames)")
    frame = model.to_geodataframe(layer)
    rows = {
        "tracks": len(model.track_id), "knots": len(model.offset), "nodes": len(model.nodes.id),
        "mileposts": len(model.mileposts.track), "movements": len(model.movements),
    }  # fmt: skip
    assert len(frame) == rows[layer]
    if layer == "movements":
        assert set(frame["end_a"]) <= {"start", "finish"}
        return
    assert isinstance(frame, geopandas.GeoDataFrame)
    assert frame.crs.is_projected
    assert frame.crs.name == model.frame.name
    if layer == "tracks":
        np.testing.assert_allclose(frame["length_m"], model.lengths)
        np.testing.assert_allclose(frame.length, model.lengths, rtol=1e-3)
    if layer == "nodes":
        np.testing.assert_array_equal(frame.geometry.x, model.nodes.easting)


def test_a_solution_is_a_frame(solution, model):
    pytest.importorskip("geopandas", reason="geopandas is not installed (extra frames)")
    table = pa.table(solution)
    assert table.column_names[:4] == ["time_s", "track", "offset_m", "line"]
    placed = solution.track >= 0
    assert table["offset_m"].null_count == int((~placed).sum())
    frame = solution.to_geodataframe()
    assert len(frame) == len(solution.time)
    np.testing.assert_array_equal(frame.geometry.is_empty | frame.geometry.isna(), ~placed)
    np.testing.assert_allclose(frame.geometry.x[placed], solution.easting[placed], rtol=0, atol=0)
    back = frame[placed].to_crs("EPSG:4326")
    np.testing.assert_allclose(back.geometry.y, np.degrees(solution.latitude[placed]), atol=1e-8)


def test_frames_go_to_files_of_gis_programs_and_back(model, tmp_path):
    geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed (extra frames)")
    pytest.importorskip("pyogrio", reason="pyogrio is not installed (extra frames)")
    tracks = model.to_geodataframe("tracks")
    tracks.to_file(tmp_path / "tracks.gpkg", driver="GPKG")
    again = geopandas.read_file(tmp_path / "tracks.gpkg")
    np.testing.assert_allclose(again.length, tracks.length, rtol=1e-12)
    stored = tmp_path / "model.gpkg"
    model.to_file(stored)
    drawn = geopandas.read_file(stored, layer="tracks")  # what QGIS shows of a stored model
    np.testing.assert_allclose(drawn.length, tracks.length, rtol=1e-5)


def test_refusals(model, solution, monkeypatch):
    with pytest.raises(TrackError, match="has no layer 'rails'"):
        model_table(model, "rails")
    monkeypatch.setitem(sys.modules, "geopandas", None)
    with pytest.raises(RailnavError, match=r"railnav\[frames\]"):
        model.to_geodataframe()
    with pytest.raises(RailnavError, match=r"railnav\[frames\]"):
        solution.to_geodataframe()
    assert solution_table(solution).num_rows == len(solution.time)  # Arrow needs no extra
