"""The track graph: movements, routes, search, chainage, immutability, validation."""

from __future__ import annotations

import itertools
from dataclasses import replace

import networkx as nx
import numpy as np
import pytest

from railnav.errors import TrackError
from railnav.geodesy.grid import choose_frame
from railnav.track import NodeKind, TrackSection, assemble, fit_alignment, validate

FRAME = choose_frame(np.radians([50.0, 50.1]), np.radians([9.0, 9.1]))
EAST, NORTH = FRAME.to_grid(np.radians(50.05), np.radians(9.05))[:2]


def section(name, start, finish, *, bulge=0.0, height=100.0, **options):
    """Track between two points (east, north from the origin), tangential to north at both ends."""
    (x0, y0), (x1, y1) = start, finish
    u = np.linspace(0, 1, 41)
    blend = 10 * u**3 - 15 * u**4 + 6 * u**5
    east = x0 + (x1 - x0) * blend + bulge * np.sin(np.pi * u) ** 2
    north = y0 + (y1 - y0) * u
    return TrackSection(name, fit_alignment(FRAME, EAST + east, NORTH + north, np.full(41, height)), **options)


def loop_station():
    """in - (main | loop) - out: two turnouts facing each other."""
    return assemble(
        FRAME,
        [
            section("in", (0, 0), (0, 200), line="1", start_chainage=0.0, end_chainage=200.0),
            section("main", (0, 200), (0, 700), line="1", start_chainage=200.0, end_chainage=700.0),
            section("loop", (0, 200), (0, 700), bulge=8.0),
            section("out", (0, 700), (0, 1000), line="1", start_chainage=10_000.0, end_chainage=9_700.0),
        ],
    )


def moves(model):
    return {frozenset((model.track_id[a], model.track_id[b])) for a, _, b, _ in model.movements}


def test_a_turnout_permits_both_legs_but_never_leg_to_leg():
    model = loop_station()
    assert moves(model) == {frozenset(p) for p in (("in", "main"), ("in", "loop"), ("main", "out"), ("loop", "out"))}
    kinds = [NodeKind(k) for k in model.nodes.kind]
    assert kinds.count(NodeKind.TURNOUT) == 2
    assert kinds.count(NodeKind.END_OF_MODEL) == 2


def test_every_walk_on_the_graph_is_lawful():
    model = loop_station()
    permitted = {(a, b) for a, _, b, _ in model.movements.tolist()} | {
        (b, a) for a, _, b, _ in model.movements.tolist()
    }
    graph = model.graph
    for source, target in itertools.product(graph, repeat=2):
        if not nx.has_path(graph, source, target):
            continue
        path = nx.shortest_path(graph, source, target, weight="weight")
        for u, v in itertools.pairwise(path):
            if u[0] != v[0]:
                assert (model.track_index(u[0]), model.track_index(v[0])) in permitted
                assert (u[2], v[2]) == ("in", "out")
    assert not nx.has_path(graph, ("main", "finish", "out"), ("loop", "finish", "in"))  # would reverse in the turnout


def test_routes_carry_true_lengths_and_directions():
    model = loop_station()
    direct, around = model.routes("in", "out")
    assert direct.tracks == ("in", "main", "out")
    assert direct.directions == (1, 1, 1)
    assert direct.length == pytest.approx(model.length("in") + model.length("main") + model.length("out"))
    assert around.tracks == ("in", "loop", "out")
    back = model.routes("out", "in")[0]
    assert back.directions == (-1, -1, -1)
    assert back.length == pytest.approx(direct.length)
    assert model.routes("main", "loop") == []


def test_a_plain_diamond_has_no_slip():
    cross = 30.0
    model = assemble(
        FRAME,
        [
            TrackSection(n, fit_alignment(FRAME, EAST + np.array(e), NORTH + np.array(y)))
            for n, e, y in (
                ("a1", [0, 0], [-200, 0]),
                ("a2", [0, 0], [0, 200]),
                ("b1", [-cross, 0], [-200, 0]),
                ("b2", [0, cross], [0, 200]),
            )
        ],
    )
    assert moves(model) == {frozenset(("a1", "a2")), frozenset(("b1", "b2"))}
    assert NodeKind.CROSSING in model.nodes.kind


def test_bridges_do_not_join():
    model = assemble(FRAME, [section("low", (0, 0), (0, 200)), section("high", (0, 200), (0, 400), height=108.0)])
    assert len(model.movements) == 0
    assert len(model.nodes.id) == 4


def test_locate_finds_all_tracks_nearest_first_and_says_nothing_far_away():
    model = loop_station()
    found = model.locate(EAST + 3.0, NORTH + 450.0)
    assert [c.track for c in found] == ["main", "loop"]
    assert found[0].distance == pytest.approx(3.0, abs=1e-6)
    assert found[1].distance == pytest.approx(5.0, abs=1e-2)
    assert model.locate(EAST + 3.0, NORTH + 450.0, within=4.0)[-1].track == "main"
    assert model.locate(EAST + 5000.0, NORTH) == []
    assert model.locate(EAST - 1e7, NORTH - 1e7) == []
    with pytest.raises(TrackError, match="not finite"):
        model.locate(float("nan"), NORTH)


def test_locate_agrees_with_brute_force():
    model = loop_station()
    generator = np.random.default_rng(5)
    which = np.repeat(np.arange(4), 2000)
    s = np.concatenate([np.linspace(0, length, 2000) for length in model.lengths])
    points = model.at(which, s)
    near, far = 0, 0
    for east, north in zip(generator.uniform(-60, 60, 40), generator.uniform(-50, 1050, 40), strict=True):
        distance = np.hypot(points.easting - EAST - east, points.northing - NORTH - north)
        found = {c.track: c.distance for c in reversed(model.locate(EAST + east, NORTH + north, within=50.0))}
        for i, name in enumerate(model.track_id):
            nearest = distance[which == i].min()
            if nearest < 49.5:
                assert found[name] == pytest.approx(nearest, abs=0.02)
                near += 1
            elif nearest > 50.5:
                assert name not in found
                far += 1
    assert min(near, far) > 20


def test_chainage_jumps_and_runs_backwards_while_offset_does_not():
    model = loop_station()
    assert model.at("main", 0.0).chainage == pytest.approx(200.0)
    assert model.at("out", 0.0).chainage == pytest.approx(10_000.0)
    middle = model.length("out") / 2
    assert model.at("out", middle).chainage == pytest.approx(9850.0)
    assert np.isnan(model.at("loop", 10.0).chainage)


def test_what_the_model_does_not_have_is_refused_with_a_hint():
    model = loop_station()
    with pytest.raises(TrackError, match="did you mean main"):
        model.at("mian", 0.0)
    with pytest.raises(TrackError, match=r"is not on track 'main', 0\.\."):
        model.at("main", model.length("main") + 1.0)
    with pytest.raises(TrackError, match="twice"):
        assemble(FRAME, [section("a", (0, 0), (0, 100)), section("a", (0, 100), (0, 200))])
    with pytest.raises(TrackError, match="at least one"):
        assemble(FRAME, [])


def test_a_model_cannot_be_changed():
    model = loop_station()
    with pytest.raises(ValueError, match="read-only"):
        model.easting[0] = 0.0
    with pytest.raises(AttributeError):
        model.track_id = ()  # type: ignore[misc]
    with pytest.raises(TrackError, match="do not grow"):
        replace(model, offset=np.asarray(model.offset)[::-1].copy())


def test_validation_names_all_defects_at_once():
    good = loop_station()
    assert validate(good) == []
    bad = assemble(
        FRAME,
        [
            section("in", (0, 0), (0, 200)),
            section("gap", (0.2, 200), (0, 700)),
            section("twin", (0, 0), (0, 200)),
            TrackSection("kink", fit_alignment(FRAME, EAST + np.array([0, 30]), NORTH + np.array([700, 900]))),
            section("apart", (300, 0), (300, 100)),
        ],
    )
    kinds = {d.kind for d in validate(bad)}
    assert kinds >= {"gap", "kink", "duplicate", "missing heights", "disconnected", "impossible turnout"}
    moved = np.asarray(good.easting).copy()
    moved[300] += 0.5
    assert "inconsistent knots" in {d.kind for d in validate(replace(good, easting=moved))}
