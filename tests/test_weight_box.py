"""Bounds over a box of weights: against samples of the box, a grid, and limits that leave nothing."""

from dataclasses import replace
from functools import cache
from itertools import product
from types import SimpleNamespace

import jax
import learning
import numpy as np
import pytest

from gnn.config import PRESETS
from gnn.decode import Integrator
from repair.bounds import layer_at
from repair.constraints.barrier import Barrier
from repair.constraints.polygon import Polygon
from repair.encode import replaced
from repair.errors import Status
from repair.network import Situations, actions
from repair.problem import Problem, deviation, outputs, violations
from repair.solve import Limits
from repair.weight_box import Polished, polish
from swarm_mjcf.errors import SpecError

CONFIG = replace(PRESETS["thesis-ch5"], edge_hidden=(3,), message=2, node_hidden=(3,))
KINEMATICS = Integrator(dt=0.5, substeps=2, max_speed=5.0, max_acceleration=4.0)
BODIES = SimpleNamespace(agent_radius=0.5, obstacle_radius=1.0)
SCALES = learning.scales()
EDGE, NODE = "edge/obstacle/layer1", "node/layer0"
LIMITS = Limits(gap=0.01, nodes=500)


@cache
def network() -> dict:
    history, _, graph = learning.random_swarm(0)
    return learning.initial(CONFIG, SCALES, history, graph, 0)


def around(count: int) -> Situations:
    """Agents that fly towards the obstacle, from several sides."""
    angle = 0.3 + np.linspace(0, 2 * np.pi, count, endpoint=False)
    side = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    own = np.concatenate([2.1 * side, -1.2 * side + 0.2 * side[:, ::-1]], axis=1)
    places = {"goal": np.array([[3.0, 2.0, 0, 0]]), "obstacle": np.zeros((1, 4)), "agent": np.array([[-9.0, 0, 0, 1]])}
    return Situations(
        own=own,
        senders={name: np.repeat(at[None], count, axis=0) for name, at in places.items()},
        present={name: np.ones((count, len(at)), bool) for name, at in places.items()},
    )


def problem(count: int = 3, constraint=Barrier, **others) -> Problem:
    rows = around(count)
    targets = actions(network(), SCALES, rows)
    kind = constraint(kinematics=KINEMATICS)
    return Problem(scales=SCALES, situations=rows, targets=targets, constraint=kind, bodies=BODIES, **others)


def moved(params: dict, path: str, change: np.ndarray) -> dict:
    return replaced(params, path, change[:-1], change[-1])


def samples(params: dict, path: str, radius: float, count: int, seed: int = 0):
    """Weights of the box: inside it, and at its corners."""
    rng = np.random.default_rng(seed)
    inputs, wide = layer_at(params, path)["kernel"].shape
    for number in range(count):
        change = rng.uniform(-1, 1, (inputs + 1, wide))
        yield moved(params, path, radius * (np.sign(change) if number % 3 == 0 else change))


def cost(question: Problem, params: dict) -> float:
    out = outputs(question, params)
    # The bound is of weights that keep the margin.
    missed = np.maximum(question.conditions.short(outputs(question, params)) + question.margin, 0).min(axis=1).sum()
    if question.price is None:
        return deviation(question, out) if missed == 0 else np.inf
    return deviation(question, out) + question.price * float(missed)


def consistent(found: Polished, question: Problem, given: dict, radius: float, path: str = EDGE) -> None:
    out = outputs(question, found.params)
    assert found.incumbent is not None
    assert found.bound is not None
    assert found.bound <= found.incumbent
    assert found.start is None or found.incumbent <= found.start
    missed = violations(question, out)
    assert found.violated == (missed > 0).sum()
    assert found.incumbent == pytest.approx(deviation(question, out) + (question.price or 0) * missed.sum())
    for now, was in zip(layer_at(found.params, path).values(), layer_at(given, path).values(), strict=True):
        assert np.abs(now - was).max() <= radius * (1 + 1e-6) + 1e-6
        assert now.dtype == np.float32
    same = jax.tree.map(lambda a, b: bool((a == b).all()), found.params, given)
    others = [ok for at, ok in jax.tree_util.tree_leaves_with_path(same) if path not in _name(at)]
    assert others
    assert all(others)


def _name(at: tuple) -> str:
    return "/".join(str(key.key) for key in at)


@pytest.mark.parametrize(("constraint", "largest"), [(Barrier, 4), (Barrier, 0), (Polygon, 2)])
def test_no_sample_of_the_box_beats_the_bound(constraint, largest):
    question, given = problem(4, constraint, price=5.0), network()
    before = jax.tree.map(np.copy, given)
    found = polish(given, question, free=EDGE, radius=0.3, limits=LIMITS, largest=largest)
    consistent(found, question, given, 0.3)
    assert found.start == pytest.approx(cost(replace(question, margin=0.0), given))
    assert found.incumbent < 0.99 * found.start
    assert min(cost(question, tried) for tried in samples(given, EDGE, 0.3, 120)) >= found.bound - 1e-6
    # Around the best point too.
    for tried in samples(found.params, EDGE, 1e-3, 40):
        inside = jax.tree.map(lambda a, b: np.abs(a - b).max() <= 0.3, layer_at(tried, EDGE), layer_at(given, EDGE))
        assert not all(inside.values()) or cost(question, tried) >= found.bound - 1e-6
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), given, before))


def test_a_margin_that_is_charged_for_is_no_part_of_the_bound():
    """All of a small box breaks the conditions: weights that cost less than what was found must not beat the bound."""
    question, given = problem(4, price=5.0, margin=0.05), network()
    found = polish(given, question, free=EDGE, radius=0.05, limits=LIMITS)
    consistent(found, question, given, 0.05)
    least = min(cost(replace(question, margin=0.0), tried) for tried in samples(given, EDGE, 0.05, 300))
    assert found.bound <= least < found.incumbent


def test_hard_conditions_are_kept_and_proven():
    question, given = problem(3, limit=4.0), network()
    found = polish(given, question, free=NODE, radius=1.0, limits=LIMITS)
    consistent(found, question, given, 1.0, NODE)
    assert found.start is None
    assert (found.status, found.violated) == (Status.OPTIMAL, 0)
    assert found.gap <= 0.01
    # From what it found, nothing is lost, and little is left to win in a box around that.
    again = polish(found.params, question, free=NODE, radius=0.01, limits=LIMITS)
    consistent(again, question, found.params, 0.01, NODE)
    assert again.start == pytest.approx(found.incumbent)
    assert again.bound >= found.bound - 1e-6


def test_groups_only_help():
    question, given = problem(5, price=5.0), network()
    best = polish(given, question, free=EDGE, radius=0.2, limits=Limits(gap=1e-4))
    # No nodes at all: the bound is that of the groups or of the relaxation.
    few = Limits(gap=1e-4, nodes=0)
    alone = polish(given, question, free=EDGE, radius=0.2, limits=few, largest=0)
    grouped = polish(given, question, free=EDGE, radius=0.2, limits=few, largest=4)
    for found in (alone, grouped, best):
        consistent(found, question, given, 0.2)
    assert alone.bound <= grouped.bound + 1e-6 <= best.incumbent + 2e-6


def test_a_grid_of_two_biases():
    """Free weights are those of a layer: with the kernel's inputs at 0, its two biases are all that acts."""
    given = jax.tree.map(np.copy, network())
    given["edge"]["obstacle"]["layer0"]["kernel"][:] = 0
    given["edge"]["obstacle"]["layer0"]["bias"][:] = -1
    question, radius = problem(2, price=2.0), 0.5
    found = polish(given, question, free=EDGE, radius=radius, limits=Limits(gap=1e-4))
    best = np.inf
    for one, other in product(np.linspace(-radius, radius, 15), repeat=2):
        change = np.zeros((4, 2))
        change[-1] = one, other
        best = min(best, cost(question, moved(given, EDGE, change)))
    assert found.bound <= best
    assert found.incumbent <= best + 1e-6
    assert found.incumbent >= 0.8 * best


def test_limits_and_boxes_that_leave_nothing():
    question, given = problem(3, limit=4.0), network()
    no_time = polish(given, question, free=NODE, radius=1.0, limits=Limits(seconds=0.0))
    assert (no_time.status, no_time.incumbent, no_time.gap) == (Status.NO_INCUMBENT, None, None)
    assert no_time.bound == 0
    assert no_time.violated > 0
    narrow = polish(given, question, free=NODE, radius=1e-4, limits=LIMITS)
    assert (narrow.status, narrow.incumbent, narrow.bound) == (Status.INFEASIBLE, None, None)
    for found in (no_time, narrow):
        assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), found.params, given))
    # A start that holds is an incumbent without any time.
    held = polish(given, question, free=NODE, radius=1.0, limits=LIMITS)
    kept = polish(held.params, question, free=NODE, radius=0.1, limits=Limits(seconds=0.0))
    assert (kept.status, kept.incumbent, kept.bound) == (Status.FEASIBLE, kept.start, 0)
    assert kept.gap == 1
    # With a price there always is one.
    priced = polish(given, replace(question, price=1.0), free=NODE, radius=1e-4, limits=Limits(seconds=0.0))
    assert priced.status == Status.ELASTIC


def test_nothing_to_do_is_optimal():
    question = replace(problem(3), constraint=None, bodies=None)
    found = polish(network(), question, free="node/layer0", radius=0.1, limits=LIMITS)
    assert (found.status, found.gap) == (Status.OPTIMAL, pytest.approx(0, abs=1e-3))


@pytest.mark.parametrize("reached", [1, 2])
def test_rows_that_the_layer_does_not_reach(reached):
    question, given = problem(3, price=5.0), network()
    seen = question.situations.present | {"obstacle": np.arange(3)[:, None] < reached}
    question = replace(question, situations=replace(question.situations, present=seen))
    found = polish(given, question, free=EDGE, radius=0.3, limits=LIMITS)
    consistent(found, question, given, 0.3)
    assert found.incumbent < found.start


def test_settings_are_checked():
    for radius, largest in ((0.0, 4), (np.inf, 4), (0.1, -1)):
        with pytest.raises(SpecError):
            polish(network(), problem(), free=EDGE, radius=radius, largest=largest)
    with pytest.raises(SpecError, match="layer"):
        polish(network(), problem(), free="edge/obstacle/layer9", radius=0.1)
