"""Measures of collective motion on groups drawn by hand, and what must not change them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from learning import blank

import envs.collective
from envs.collective import STILL, UNITS, collective_measures, collective_report, nearest_neighbour
from envs.trajectories import AGENT, GOAL, OBSTACLE

SQUARE = [(1, 0), (0, 1), (-1, 0), (0, -1)]


def measures(position, velocity, present=None) -> dict[str, float]:
    """Measures of one row of agents, beside a goal and an obstacle that must not count."""
    position, velocity = np.asarray(position, float).reshape(-1, 2), np.asarray(velocity, float).reshape(-1, 2)
    still = np.array([[500.0, 500], [-300, 10]])
    mask = None
    if present is not None:
        mask = np.concatenate([[True, True], present])[None, None]
    data = blank(
        np.concatenate([still, position])[None, None],
        np.concatenate([0 * still, velocity])[None, None],
        [GOAL, OBSTACLE] + [AGENT] * len(position),
        mask,
    )
    return {name: float(values[0, 0]) for name, values in collective_measures(data).items()}


def turned(vectors, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(vectors) @ np.array([[c, s], [-s, c]])


def test_a_parallel_flock():
    """Corners of a 3 x 4 m rectangle, all flying north-east at different speeds."""
    found = measures([(0, 0), (3, 0), (3, 4), (0, 4)], [(1, 1), (2, 2), (3, 3), (4, 4)])
    assert found["polarisation"] == pytest.approx(1)
    assert found["milling"] == pytest.approx(0, abs=1e-12)
    assert found["spread"] == found["spread_rms"] == pytest.approx(2.5)
    assert found["nearest_neighbour_mean"] == found["nearest_neighbour_min"] == pytest.approx(3)


def test_a_group_that_moves_as_one_has_no_angular_momentum_however_it_is_shaped():
    found = measures([(0, 0), (1, 0), (9, 5)], [(2, 1)] * 3)
    assert found["angular_momentum"] == pytest.approx(0, abs=1e-7)
    assert found["milling"] > 0.02, "unweighted, an uneven group is not quite 0"


@pytest.mark.parametrize("way", [1, -1])
def test_a_mill(way: int):
    found = measures(np.multiply(SQUARE, 2), way * turned(SQUARE, math.pi / 2))
    assert found["polarisation"] == pytest.approx(0, abs=1e-7)
    assert found["milling"] == pytest.approx(1)
    assert found["angular_momentum"] == pytest.approx(1)
    assert found["spread"] == pytest.approx(2)
    assert found["nearest_neighbour_mean"] == pytest.approx(2 * math.sqrt(2))


def test_a_mill_of_which_one_in_four_turns_the_other_way():
    velocity = turned(SQUARE, math.pi / 2) * np.array([[1], [1], [1], [-1]])
    found = measures(SQUARE, velocity)
    assert found["milling"] == pytest.approx((3 - 1) / 4)
    assert found["angular_momentum"] == pytest.approx((3 - 1) / 4)
    assert found["polarisation"] == pytest.approx(2 / 4)  # those at east and west both fly north


def test_weights_of_distance_and_speed():
    """Two on the x axis about the origin at 1 m and, as a third balances them, 2 m: one turns left, two turn right."""
    found = measures([(-1, 0), (-1, 0), (2, 0)], [(0, 3), (0, 3), (0, 6)])
    # Cross products with unit vectors: -1, -1, +1. With lengths: -3, -3, +12.
    assert found["milling"] == pytest.approx(1 / 3)
    assert found["angular_momentum"] == pytest.approx((12 - 6) / (12 + 6))


def test_two_that_pass_each_other_head_on():
    found = measures([(-5, 0), (5, 0)], [(4, 0), (-4, 0)])
    assert found["polarisation"] == pytest.approx(0)
    assert found["milling"] == 0
    assert (found["spread"], found["nearest_neighbour_min"]) == (5, 10)


def test_a_single_agent():
    found = measures([(7, 7)], [(0, 2)])
    assert found["polarisation"] == pytest.approx(1)
    assert found["spread"] == found["spread_rms"] == 0
    for name in ("milling", "angular_momentum", "nearest_neighbour_mean", "nearest_neighbour_min"):
        assert math.isnan(found[name]), name


def test_nobody_at_all():
    found = measures([(1, 0), (2, 0)], [(1, 0), (1, 0)], present=[False, False])
    assert all(math.isnan(value) for value in found.values())


def test_a_group_that_stands_still_has_no_heading():
    found = measures(SQUARE, np.full((4, 2), STILL / 2))
    for name in ("polarisation", "milling", "angular_momentum"):
        assert math.isnan(found[name]), name
    assert found["spread"] == pytest.approx(1)


def test_those_who_stand_are_left_out_of_headings_alone():
    found = measures([(0, 0), (4, 0), (0, 4)], [(1, 0), (0, 0), (0, 1)])
    assert found["polarisation"] == pytest.approx(math.sqrt(2) / 2)
    assert found["nearest_neighbour_mean"] == pytest.approx(4)


def test_spread_and_nearest_neighbours_by_hand():
    found = measures([(0, 0), (1, 0), (5, 0)], np.ones((3, 2)))
    assert found["spread"] == pytest.approx((2 + 1 + 3) / 3)
    assert found["spread_rms"] == pytest.approx(math.sqrt((4 + 1 + 9) / 3))
    assert found["nearest_neighbour_mean"] == pytest.approx((1 + 1 + 4) / 3)
    assert found["nearest_neighbour_min"] == 1


def test_two_in_one_place_are_0_apart():
    found = measures([(3, 3), (3, 3), (9, 3)], np.ones((3, 2)))
    assert (found["nearest_neighbour_min"], found["nearest_neighbour_mean"]) == (0, 2)


def random_group(seed: int, agents: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    present = rng.random(agents) < 0.8
    return rng.uniform(-50, 50, (agents, 2)), rng.normal(0, 5, (agents, 2)), present


@given(st.integers(0, 10_000), st.floats(-4, 4), st.floats(-900, 900), st.floats(-900, 900))
def test_nothing_depends_on_place_direction_order_or_ghosts(seed: int, angle: float, x: float, y: float):
    position, velocity, present = random_group(seed)
    expected = measures(position, velocity, present)
    order = np.random.default_rng(seed + 1).permutation(len(position))
    for name, changed in {
        "moved": measures(position + np.array([x, y]), velocity, present),
        "turned": measures(turned(position, angle), turned(velocity, angle), present),
        "mirrored": measures(position * (1, -1), velocity * (1, -1), present),
        "reordered": measures(position[order], velocity[order], present[order]),
        "without ghosts": measures(position[present], velocity[present]) if present.any() else expected,
    }.items():
        for measure, value in expected.items():  # positions are float32 in the record: 1e-4 m at 900 m
            np.testing.assert_allclose(changed[measure], value, rtol=1e-3, atol=1e-3, err_msg=f"{name}, {measure}")


@given(st.integers(0, 10_000))
def test_bounds(seed: int):
    found = measures(*random_group(seed))
    for name in ("polarisation", "milling", "angular_momentum"):
        assert math.isnan(found[name]) or 0 <= found[name] <= 1 + 1e-12
    if not math.isnan(found["nearest_neighbour_mean"]):
        assert found["nearest_neighbour_min"] <= found["nearest_neighbour_mean"] + 1e-12
        assert found["spread"] <= found["spread_rms"] + 1e-12


@pytest.mark.parametrize("points", [1 << 18, 40])
def test_nearest_neighbours_are_those_of_all_pairs(points: int, monkeypatch: pytest.MonkeyPatch):
    """Many rows, of which some are empty, against every pair in NumPy; with one tree, and with one for every 4 rows."""
    monkeypatch.setattr(envs.collective, "_POINTS", points)
    rng = np.random.default_rng(0)
    position, present = rng.uniform(-90, 90, (5, 13, 10, 2)), rng.random((5, 13, 10)) < rng.random((5, 13, 1))
    apart = np.linalg.norm(position[..., :, None, :] - position[..., None, :, :], axis=-1)
    apart[~(present[..., :, None] & present[..., None, :]) | np.eye(10, dtype=bool)] = np.inf
    expected = apart.min(axis=-1)
    found = nearest_neighbour(position, present)
    assert np.isinf(expected).any()
    np.testing.assert_allclose(found, np.where(np.isinf(expected), np.nan, expected), rtol=1e-12)


def test_measures_of_every_scene_and_row_are_those_of_that_row_alone():
    rng = np.random.default_rng(1)
    position, velocity = rng.uniform(-20, 20, (3, 4, 5, 2)), rng.normal(0, 3, (3, 4, 5, 2))
    mask = rng.random((3, 4, 5)) < 0.7
    whole = collective_measures(blank(position, velocity, [AGENT] * 5, mask))
    assert list(whole) == list(UNITS)
    for s, t in np.ndindex(3, 4):
        one = measures(position[s, t], velocity[s, t], mask[s, t])
        for name, values in whole.items():
            assert values.shape == (3, 4)
            np.testing.assert_allclose(values[s, t], one[name], rtol=1e-5, err_msg=name)


def test_a_report_means_over_time_and_then_over_scenes():
    spreads = np.array([[1.0, 3], [5, 5], [np.nan, 7], [np.nan, np.nan]])
    report = collective_report({"spread": spreads})
    assert report["spread_mean"].value == pytest.approx((2 + 5 + 7) / 3)
    assert report["spread_final"].value == pytest.approx((3 + 5 + 7) / 3)
    for estimate in report.values():
        assert estimate.unit == "m"
        assert estimate.low is not None
        assert estimate.high is not None
        assert 2 <= estimate.low < estimate.value < estimate.high <= 7


def test_a_report_of_what_is_nowhere_defined_is_nan_without_an_interval():
    group = blank(np.zeros((2, 3, 1, 2)), np.zeros((2, 3, 1, 2)), [AGENT])
    report = collective_report(collective_measures(replace(group)))
    assert math.isnan(report["polarisation_mean"].value)
    assert report["polarisation_final"].low is None
    assert report["spread_mean"].value == 0
