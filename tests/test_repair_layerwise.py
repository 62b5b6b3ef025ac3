"""Layer-wise rotation: a merit that never rises, evaluated by forward passes alone."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import jax
import learning
import numpy as np
import pytest

from gnn.config import PRESETS
from gnn.decode import Integrator
from repair.bounds import paths
from repair.constraints.barrier import Barrier
from repair.constraints.diamond import Diamond
from repair.encounters import encounters
from repair.errors import Status
from repair.layerwise import layerwise, merit
from repair.network import Situations, actions
from repair.problem import Problem
from repair.solve import Limits
from swarm_mjcf.errors import SpecError

CONFIG = replace(PRESETS["thesis-ch5"], edge_hidden=(3,), message=2, node_hidden=(3,))
KINEMATICS = Integrator(dt=0.5, substeps=2, max_speed=5.0, max_acceleration=4.0)
BODIES = SimpleNamespace(agent_radius=0.5, obstacle_radius=1.0)
SCALES = learning.scales()
LIMITS = Limits(nodes=30)


@cache
def network() -> dict:
    history, _, graph = learning.random_swarm(0)
    return learning.initial(CONFIG, SCALES, history, graph, 0)


def near_the_obstacle() -> Situations:
    own = np.array([[1.6, 0.2, -1.2, 0.1], [-0.3, 1.7, 0.2, -0.9]])
    places = {"goal": np.array([[3.0, 2.0, 0, 0]]), "obstacle": np.zeros((1, 4)), "agent": np.array([[-4.0, 0, 0, 1]])}
    return Situations(
        own=own,
        senders={name: np.repeat(at[None], 2, axis=0) for name, at in places.items()},
        present={name: np.ones((2, len(at)), bool) for name, at in places.items()},
    )


def problem(kind=Diamond) -> Problem:
    situations = near_the_obstacle()
    targets = actions(network(), SCALES, situations)
    constraint = kind(kinematics=KINEMATICS)
    return Problem(scales=SCALES, situations=situations, targets=targets, constraint=constraint, bodies=BODIES)


def by_hand(params: dict, kind=Diamond, price: float = 5.0) -> float:
    """The merit from the network's actions and the constraint's own slack."""
    question = problem(kind)
    out = actions(params, SCALES, question.situations)
    slack = kind(kinematics=KINEMATICS).slack(encounters(question.situations, BODIES), out)
    per_action = 1 / kind(kinematics=KINEMATICS).push if kind is Diamond else 1.0
    short = np.where(np.isfinite(slack), np.maximum(-slack, 0), 0) * per_action
    return float(np.abs(out - question.targets).sum(axis=1).mean() + price * short.sum())


@pytest.mark.parametrize("kind", [Diamond, Barrier])
def test_the_merit_never_rises_and_is_what_it_says(kind):
    params = network()
    kept = jax.tree.map(np.copy, params)
    seen = []
    chosen = ["readout/layer0", "node/layer0", "edge/obstacle/layer1"]
    result = layerwise(
        params, problem(kind), radius=0.3, price=5.0, layers=chosen, rounds=2, limits=LIMITS, progress=seen.append
    )
    assert jax.tree.all(jax.tree.map(lambda a, b: (np.asarray(a) == b).all(), params, kept))
    assert tuple(seen) == result.history
    assert [step.layer for step in seen] == chosen * (len(seen) // 3)
    np.testing.assert_allclose(seen[0].before, by_hand(params, kind), rtol=1e-6)
    for step, after in pairwise(seen):
        assert after.before == (step.after if step.accepted else step.before)
    assert all(step.accepted == (step.after < step.before) for step in seen)
    assert result.merit < 0.8 * seen[0].before
    np.testing.assert_allclose(result.merit, by_hand(result.params, kind), rtol=1e-6)
    assert {np.asarray(leaf).dtype for leaf in jax.tree.leaves(result.params)} == {np.dtype(np.float32)}


def test_it_ends_after_a_round_that_takes_nothing():
    """Nothing to repair: the weights are already the best there are."""
    easy = replace(problem(), constraint=None, bodies=None)
    result = layerwise(network(), easy, radius=0.1, layers=["readout/layer0", "node/layer0"], limits=LIMITS)
    assert [step.accepted for step in result.history] == [False, False]
    assert result.merit < 1e-6


def test_all_layers_from_the_last_to_the_first():
    result = layerwise(network(), problem(), radius=0.02, price=5.0, rounds=1, limits=LIMITS)
    assert [step.layer for step in result.history] == paths(network())
    assert result.history[0].layer == "readout/layer0"
    assert result.history[-1].layer.startswith("edge/")


def test_hard_conditions_say_that_the_box_is_too_small_and_take_nothing():
    result = layerwise(
        network(), problem(), radius=0.01, layers=["readout/layer0"], elastic=False, solver="HIGHS", limits=LIMITS
    )
    (step,) = result.history
    assert (step.status, step.accepted, step.gap) == (Status.INFEASIBLE, False, None)
    assert step.after == step.before == result.merit == merit(problem(), network(), 1.0)


def test_no_time_takes_nothing():
    result = layerwise(
        network(),
        problem(),
        radius=0.3,
        layers=["node/layer0"],
        elastic=False,
        solver="HIGHS",
        limits=Limits(seconds=0.0),
    )
    assert result.history[0].status == Status.NO_INCUMBENT
    assert jax.tree.all(jax.tree.map(lambda a, b: (np.asarray(a) == b).all(), result.params, network()))


def test_hard_conditions_are_met_where_the_box_allows():
    result = layerwise(
        network(), problem(), radius=4.0, layers=["readout/layer0"], elastic=False, rounds=1, limits=LIMITS
    )
    slack = Diamond(kinematics=KINEMATICS).slack(
        encounters(near_the_obstacle(), BODIES), actions(result.params, SCALES, near_the_obstacle())
    )
    assert slack.min() >= 0
    assert result.history[0].status == Status.OPTIMAL


def test_names_and_rounds_are_checked():
    with pytest.raises(SpecError, match=r"layers.*node/layer9.*readout/layer0"):
        layerwise(network(), problem(), radius=0.1, layers=["node/layer9"])
    with pytest.raises(SpecError, match="rounds"):
        layerwise(network(), problem(), radius=0.1, rounds=0)
