"""Branch and bound over sectors, against brute force and against answers known beforehand."""

from itertools import product

import numpy as np
import pytest
from learning import INTEGRATOR, initial, random_swarm, scales, tiny
from scipy.optimize import nnls

from repair.branch import branch, branch_readout
from repair.constraints.disc import Disc
from repair.encounters import Encounters, encounters
from repair.errors import RepairError, Status
from repair.network import actions, situations_of
from repair.sectors import away, hull, narrowed, pieces
from swarm_mjcf.spec import SceneSpec

DISC = Disc(kinematics=INTEGRATOR)


def beside(centre: np.ndarray, radius: np.ndarray | float) -> Encounters:
    """Rows whose allowed actions lie outside discs around `centre` (R, 2) of radius `radius` [m/s^2]."""
    relative = -DISC.push * np.asarray(centre, np.float64)[:, None]
    reach = np.broadcast_to(DISC.push * np.asarray(radius, np.float64), len(relative))[:, None]
    return Encounters(
        relative=relative,
        velocity=np.zeros_like(relative),
        own_velocity=np.zeros((len(relative), 2)),
        reach=reach.copy(),
        present=np.ones(reach.shape, bool),
        steers=np.zeros(reach.shape, bool),
    )


def clearance(rows: np.ndarray, weights: np.ndarray, e: Encounters) -> np.ndarray:
    return DISC.slack(e, rows @ weights) / DISC.push


def weights_of(found) -> np.ndarray:
    return np.concatenate([found.kernel, found.bias[None]]).astype(np.float64)


def problem(seed: int, rows: int, features: int = 3, spread: float = 1.5):
    """Anchors, rows and weights, some of whose actions lie inside the discs."""
    rng = np.random.default_rng(seed)
    anchors = np.concatenate([rng.normal(size=(40, features - 1)), np.ones((40, 1))], axis=1)
    chosen, weights = anchors[:rows], rng.normal(size=(features, 2))
    return anchors, chosen, weights, beside(chosen @ weights + rng.normal(0, spread, (rows, 2)), 1.0), DISC


def brute_force(anchors, rows, weights, e, _, normals: int) -> float:
    """The best over a choice of each row's tangent, each a least-distance problem (Lawson and Hanson 1974, by NNLS)."""
    angles = 2 * np.pi * np.arange(normals) / normals
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    centre, radius = -e.relative[:, 0] / DISC.push, e.reach[:, 0] / DISC.push
    psi = rows @ np.linalg.inv(np.linalg.cholesky(anchors.T @ anchors / len(anchors))).T
    best = np.inf
    for chosen in product(directions, repeat=len(rows)):
        normal = np.array(chosen)
        planes = (psi[:, :, None] * normal[:, None]).reshape(len(rows), -1)
        offset = np.sum(normal * (centre - rows @ weights), axis=1) + radius
        stacked = np.concatenate([planes.T, offset[None]])
        aim = np.append(np.zeros(len(stacked) - 1), 1.0)
        rest = stacked @ nnls(stacked, aim)[0] - aim
        best = min(best, float(np.sum((rest[:-1] / rest[-1]) ** 2)))
    return best


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_rows_agree_with_brute_force(seed):
    given = problem(seed, 2, spread=0.4)
    found, best = branch(*given, gap=1e-3), brute_force(*given, normals=24)
    assert found.status is Status.OPTIMAL
    # 24 tangents miss the best normal by at most 7.5 degrees, so brute force is above the optimum, and not by much.
    assert found.bound <= best * (1 + 1e-4)
    assert found.incumbent <= best * (1 + 2e-3)
    assert found.incumbent >= 0.9 * best


def test_one_row_is_known():
    # One feature, the bias: the action moves straight out of the disc, the nearest way.
    anchors = np.ones((7, 1))
    found = branch(anchors, np.ones((1, 1)), np.zeros((1, 2)), beside(np.array([[-0.6, 0.0]]), 1.0), DISC, gap=1e-3)
    assert found.status is Status.OPTIMAL
    assert found.incumbent == pytest.approx(0.16, rel=5e-3)
    assert found.bias == pytest.approx([0.4, 0.0], abs=1e-2)


def test_a_detour_around_two_discs():
    # Same action, two overlapping discs: the way out is the corner where their circles meet, (0, 0.8).
    centre = np.array([[-0.6, 0.0], [0.6, 0.0]])
    found = branch(np.ones((3, 1)), np.ones((2, 1)), np.array([[0.0, 0.1]]), beside(centre, 1.0), DISC, gap=1e-3)
    assert found.status is Status.OPTIMAL
    assert found.incumbent == pytest.approx(0.49, rel=1e-2)
    assert found.bias == pytest.approx([0.0, 0.8], abs=1e-2)


def test_nothing_violated_leaves_the_weights():
    anchors, rows, weights, *_ = problem(0, 5)
    weights = weights.astype(np.float32).astype(np.float64)
    found = branch(anchors, rows, weights, beside(rows @ weights + 10, 1.0), DISC)
    assert found.status is Status.OPTIMAL
    assert (found.incumbent, found.bound, found.gap) == (0, 0, 0)
    np.testing.assert_array_equal(weights_of(found), weights.astype(np.float32))


@pytest.mark.parametrize("seed", range(4))
def test_values_and_bound_are_true(seed):
    anchors, rows, weights, e, _ = problem(seed, 12, features=6)
    found = branch(anchors, rows, weights, e, DISC, gap=0.02, nodes=3000)
    kept = weights_of(found)
    assert found.status is Status.OPTIMAL
    assert found.gap <= 0.02 * (1 + 1e-9)
    assert found.bound <= found.incumbent
    assert clearance(rows, kept, e).min() > 0
    assert np.mean(np.sum((anchors @ (kept - weights)) ** 2, axis=1)) == pytest.approx(found.incumbent, rel=1e-3)
    # No point that happens to be allowed beats the bound: random ones, and ones around the solution.
    rng = np.random.default_rng(seed)
    for spread, centre in ((1.0, weights), (0.05, kept), (0.3, kept)):
        for _ in range(300):
            tried = centre + spread * rng.normal(size=weights.shape)
            if clearance(rows, tried, e).min() >= 0:
                ridge = 1.001 * np.mean(np.sum((anchors @ (tried - weights)) ** 2, axis=1))
                assert ridge >= found.bound


def test_limits_end_it_with_a_bound():
    given = problem(5, 30, features=6)
    none, few, all_ = branch(*given, seconds=0.0), branch(*given, nodes=2), branch(*given, nodes=4000, gap=0.05)
    assert none.status is Status.NO_INCUMBENT
    assert none.kernel is None
    assert none.bias is None
    assert few.status is Status.FEASIBLE
    assert few.nodes == 2
    assert few.bound <= all_.bound + 1e-9 <= all_.incumbent + 1e-9 <= few.incumbent + 2e-9
    assert few.gap > all_.gap
    assert clearance(given[1], weights_of(few), given[3]).min() > 0


def test_same_every_time():
    given = problem(5, 20, features=6)
    first, second = branch(*given, nodes=50), branch(*given, nodes=50)
    assert (first.incumbent, first.bound, first.nodes) == (second.incumbent, second.bound, second.nodes)


def test_contradictory_rows():
    # The one action has to leave a ring of discs: nothing below the ceiling does, unless violations have a price.
    angles = np.arange(12) * np.pi / 6
    ring = 2 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    given = (np.ones((1, 1)), np.ones((13, 1)), np.full((1, 2), 0.05), beside(np.concatenate([ring, [[0, 0]]]), 1.5))
    refused = branch(*given, DISC, ceiling=2.0)
    assert refused.status is Status.INFEASIBLE
    assert refused.kernel is None
    around = branch(*given, DISC, ceiling=100.0, nodes=20)
    corner = 2 * np.cos(np.pi / 12) + np.sqrt(1.5**2 - (2 * np.sin(np.pi / 12)) ** 2)
    assert around.incumbent == pytest.approx((corner - 0.05 * np.sqrt(2)) ** 2, rel=1e-4)
    price = 0.3 / DISC.push
    elastic = branch(*given, DISC, price=price, gap=0.02, nodes=3000)
    assert elastic.status is Status.ELASTIC
    assert elastic.violated > 0
    assert elastic.bound <= elastic.incumbent

    def value(action: np.ndarray) -> float:
        short = np.maximum(-clearance(given[1], action[None], given[3]), 0).sum()
        return np.sum((action - 0.05) ** 2) + 0.3 * short

    grid = np.stack(np.meshgrid(*[np.linspace(-6, 6, 121)] * 2), axis=-1).reshape(-1, 2)
    best = min(value(action) for action in grid)
    assert elastic.bound <= best
    assert elastic.incumbent <= best * 1.05


def test_a_high_price_is_a_hard_constraint():
    given = problem(1, 8, features=4)
    hard, soft = branch(*given, nodes=500), branch(*given, price=1e6, nodes=500)
    assert soft.violated == 0
    assert soft.incumbent == pytest.approx(hard.incumbent, rel=0.02)


def test_a_network_is_repaired():
    spec = SceneSpec(substeps=60, num_agents=4, num_obstacles=2, obstacle_radius=0.8, agent_radius=0.2)
    history, _, graph = random_swarm(3, (1, 2, 4), batch=6)
    params, units = initial(tiny("thesis-ch5"), scales(), history, graph), scales()
    s = situations_of(history[:, 0], graph)
    e = encounters(s, spec)
    before = DISC.slack(e, actions(params, units, s)).min(axis=1)
    s = s.take((before > -0.05) & (before < 1))  # those inside cannot get out
    e = encounters(s, spec)
    assert (DISC.slack(e, actions(params, units, s)) < 0).any()
    found = branch_readout(params, units, s, s, e, DISC, nodes=5)
    assert found.status.solved
    repaired = {**params, "readout": {"layer0": {"kernel": found.kernel, "bias": found.bias}}}
    after = actions(repaired, units, s)
    assert DISC.slack(e, after).min() > 0
    moved = np.mean(np.sum((after - actions(params, units, s)) ** 2, axis=1))
    assert found.incumbent == pytest.approx(moved, rel=1e-2)


def test_numbers_that_are_not_finite():
    anchors, rows, weights, e, _ = problem(0, 3)
    with pytest.raises(RepairError, match="not finite"):
        branch(anchors, rows, np.full_like(weights, np.nan), e, DISC)


def inside(point: np.ndarray, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
    turn = (np.arctan2(point[..., 1], point[..., 0]) - middle + np.pi) % (2 * np.pi) - np.pi
    return np.abs(turn) <= half + 1e-9


def random_sectors(seed: int, count: int = 300):
    rng = np.random.default_rng(seed)
    half = np.where(rng.random(count) < 0.3, np.pi, rng.uniform(0.01, np.pi, count))
    middle, radius = rng.uniform(-9, 9, count), rng.uniform(0.5, 2, count)
    # Points as relaxations leave them: inside the disc and the sector.
    angle, far = middle + rng.uniform(-1, 1, count) * half, radius * np.sqrt(rng.random(count))
    at = far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return rng, middle, half, at, radius


@pytest.mark.parametrize("seed", [0, 1])
def test_no_allowed_point_is_lost(seed):
    rng, middle, half, at, radius = random_sectors(seed)
    parts = pieces(middle, half, at, radius)
    assert np.nansum(parts[1], axis=1) == pytest.approx(half)
    far = away(*parts, at, radius)
    ball = 0.8
    for _ in range(200):
        angle, size = rng.uniform(-np.pi, np.pi, len(half)), radius * rng.uniform(1, 3, len(half))
        point = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        was = inside(point, middle, half)
        within = inside(point[:, None], *parts)
        np.testing.assert_array_equal(within.any(axis=1), was)
        distance = np.linalg.norm(point - at, axis=1)
        assert (np.where(within, far, 0) <= distance[:, None] + 1e-9).all()
        narrow = half < np.pi / 2
        for kind in range(3):
            normal, offset = hull(middle, half, np.full(len(half), kind))
            assert (np.sum(normal * point, axis=1) - offset * radius >= -1e-9)[was & narrow].all()
        near = was & (distance <= ball)
        found = narrowed(middle[near], half[near], at[near], ball, radius[near])
        assert found is not None
        assert inside(point[near], *found).all()


def test_a_ball_within_the_disc_leaves_nothing():
    one = np.ones(1)
    assert narrowed(0 * one, np.pi * one, np.array([[0.2, 0.0]]), 0.5, one) is None
    found = narrowed(0 * one, np.pi * one, np.array([[2.0, 0.0]]), 1.0, one)
    assert found is not None
    assert (found[0][0], found[1][0]) == (pytest.approx(0, abs=1e-6), pytest.approx(np.pi / 6, abs=1e-6))
