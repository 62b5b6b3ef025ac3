"""A network with one free layer as a program, against forward passes, enumeration and numbers by hand."""

from dataclasses import replace
from functools import cache
from itertools import product
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import learning
import numpy as np
import pytest
from scipy import sparse

from gnn.config import PRESETS
from gnn.decode import Integrator
from gnn.features import Scales
from repair.bounds import MESSAGES, activated, chain_of, intervals, layer_at, paths, pre_activations
from repair.constraints.barrier import Barrier
from repair.constraints.diamond import Diamond
from repair.constraints.disc import Disc
from repair.constraints.polygon import Polygon
from repair.encode import encode, replaced
from repair.encounters import encounters
from repair.errors import RepairError, Status, Unbounded
from repair.limits import executed
from repair.network import Situations, actions, situations_of
from repair.problem import Problem, actions_of, deviation, outputs, state_change, violations
from repair.program import columns, each
from repair.solve import Limits, installed, solve
from swarm_mjcf.errors import SpecError

CONFIG = replace(PRESETS["thesis-ch5"], edge_hidden=(3,), message=2, node_hidden=(3,))
KINEMATICS = Integrator(dt=0.5, substeps=2, max_speed=5.0, max_acceleration=4.0)
BODIES = SimpleNamespace(agent_radius=0.5, obstacle_radius=1.0)
SCALES = learning.scales()


@cache
def network(seed: int = 0) -> dict:
    history, _, graph = learning.random_swarm(seed)
    return learning.initial(CONFIG, SCALES, history, graph, seed)


@cache
def swarm(seed: int = 0, batch: int = 1) -> Situations:
    history, _, graph = learning.random_swarm(seed, (1, 1, 2), batch=batch)
    return situations_of(history[:, -1], graph)


def problem_of(situations: Situations, params: dict, **others) -> Problem:
    """Stay near what the network does."""
    return Problem(scales=SCALES, situations=situations, targets=actions(params, SCALES, situations), **others)


def constrained(situations: Situations, params: dict, kind=Diamond, **others) -> Problem:
    return problem_of(situations, params, constraint=kind(kinematics=KINEMATICS), bodies=BODIES, **others)


def moved(params: dict, path: str, radius: float, seed: int) -> dict:
    """The network with one layer drawn anew within its box."""
    rng = np.random.default_rng(seed)
    layer = layer_at(params, path)
    kernel, bias = (rng.uniform(-radius, radius, np.shape(layer[name])) for name in ("kernel", "bias"))
    return replaced(params, path, kernel, bias)


def solved(program, **options):
    return solve(program, solver="highspy", limits=Limits(gap=1e-9, nodes=20000), **options)


@pytest.mark.parametrize("path", paths(network()))
def test_bounds_contain_whatever_weights_in_the_box_give(path):
    params, situations = network(), swarm(1, 2)
    bounds = intervals(chain_of(params, SCALES, situations, path), 0.3)
    for seed in range(30):
        for name, found in pre_activations(chain_of(moved(params, path, 0.3, seed), SCALES, situations, path)).items():
            if name != MESSAGES:
                assert (bounds[name].low <= found).all()
                assert (found <= bounds[name].high).all()
    # Exact where the weights are: every neuron is as high as its bound for some corner of the box.
    chain = chain_of(params, SCALES, situations, path)
    step = chain.steps[0]
    top = np.sign(chain.inputs)[:, :, None] * 0.3
    highest = np.einsum("ni,nio->no", chain.inputs, step.kernel + top) + step.bias + 0.3
    np.testing.assert_allclose(bounds[path].high, highest, rtol=1e-12)


def test_the_chain_is_the_network():
    params, situations = network(), swarm(2, 3)
    for path in (None, *paths(params)):
        chain = chain_of(params, SCALES, situations, path)
        found = pre_activations(chain)["readout/layer0"] * 0.7
        np.testing.assert_allclose(found, actions(params, SCALES, situations), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("path", paths(network()))
def test_with_the_weights_fixed_the_program_is_the_forward_pass(path):
    params, situations = network(), swarm(1, 2)
    problem = problem_of(situations, params)
    encoded = encode(params, problem, free=path, radius=0.4)
    weights = encoded.program.blocks["weights"]
    if path not in ("readout/layer0",):
        assert encoded.program.size["binaries"] > 0
    for seed in range(2):
        other = moved(params, path, 0.39, seed)
        start = encoded.values_of(other)
        assert encoded.program.excess(start) < 1e-9
        lower, upper = encoded.program.lower.copy(), encoded.program.upper.copy()
        lower[weights] = upper[weights] = start[weights]
        solution = solved(replace(encoded.program, lower=lower, upper=upper))
        assert solution.status == Status.OPTIMAL
        expected = actions(other, SCALES, situations)
        np.testing.assert_allclose(solution.values[encoded.program.blocks["output"]], expected, atol=1e-5)
        np.testing.assert_allclose(solution.incumbent, deviation(problem, expected), atol=1e-5)
        np.testing.assert_allclose(actions(encoded.params_of(solution.values), SCALES, situations), expected, atol=1e-5)


def test_nothing_free_and_no_room():
    params, situations = network(), swarm(1)
    problem = problem_of(situations, params)
    for free, radius in ((None, 0.0), ("node/layer0", 0.0), ("edge/agent/layer0", 0.0)):
        encoded = encode(params, problem, free=free, radius=radius)
        assert encoded.program.size["binaries"] == 0
        solution = solved(encoded.program)
        np.testing.assert_allclose(solution.values[encoded.program.blocks["output"]], problem.targets, atol=1e-6)
        assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), encoded.params_of(solution.values), params))


def one_neuron(weight: float = 1.0) -> tuple[dict, Situations, Scales]:
    """An agent at (1, 0), with a goal that does nothing; h = relu(x), action = (h, 0)."""
    rest = np.zeros((6, 1), np.float32)
    kernel = rest.copy()
    kernel[0] = weight
    edge = {"layer0": {"kernel": np.zeros((8, 2), np.float32), "bias": np.zeros(2, np.float32)}}
    params = {
        "edge": {"goal": edge},
        "node": {"layer0": {"kernel": kernel, "bias": np.zeros(1, np.float32)}},
        "readout": {"layer0": {"kernel": np.array([[1.0, 0.0]], np.float32), "bias": np.zeros(2, np.float32)}},
    }
    situations = Situations(
        own=np.array([[1.0, 0.0, 0.0, 0.0]]),
        senders={name: np.zeros((1, int(name == "goal"), 4)) for name in ("goal", "obstacle", "agent")},
        present={name: np.ones((1, int(name == "goal")), bool) for name in ("goal", "obstacle", "agent")},
    )
    return params, situations, SCALES


@pytest.mark.parametrize(
    ("weight", "target", "best"),
    [
        (1.2, 3.2, 1.0),  # h = (1.2 + 0.5) + 0.5 = 2.2 at most: 1 is left
        (1.2, 1.4, 0.0),  # within reach
        (0.2, -1.0, 1.0),  # the neuron goes off, and no ReLU goes below 0
        (-0.5, 0.25, 0.0),  # off at first; (-0.5 + 0.5) + 0.25 is within reach
        (-1.5, 1.0, 1.0),  # off whatever the weights: -1 + 0.5
    ],
)
def test_an_optimum_by_hand(weight, target, best):
    params, situations, scales = one_neuron(weight)
    problem = Problem(scales=scales, situations=situations, targets=np.array([[target, 0.0]]), normalise=False)
    encoded = encode(params, problem, free="node/layer0", radius=0.5)
    solution = solved(encoded.program)
    np.testing.assert_allclose(solution.incumbent, best, atol=1e-6)
    after = actions(encoded.params_of(solution.values), scales, situations, normalise=False)
    np.testing.assert_allclose(abs(after[0, 0] - target), best, atol=1e-6)
    assert encoded.program.size["binaries"] == (-1 < weight < 1)


def enumerated(program) -> float:
    """The least cost over all values of the open binaries, each by a linear program."""
    open_ = np.flatnonzero(program.integer & (program.lower < program.upper))
    assert 2 <= len(open_) <= 6
    costs = []
    for values in product((0.0, 1.0), repeat=len(open_)):
        lower, upper = program.lower.copy(), program.upper.copy()
        lower[open_] = upper[open_] = values
        fixed = replace(program, lower=lower, upper=upper, integer=np.zeros_like(program.integer))
        solution = solve(fixed, solver="highspy")
        costs.append(solution.incumbent if solution.status == Status.OPTIMAL else np.inf)
    return min(costs)


@pytest.mark.parametrize(
    ("path", "radius"), [("node/layer0", 0.15), ("edge/obstacle/layer0", 0.08), ("edge/obstacle/layer1", 0.2)]
)
def test_all_relu_patterns_tried(path, radius):
    params, situations = network(), swarm(3)
    targets = actions(moved(params, path, 3 * radius, 5), SCALES, situations)
    problem = Problem(scales=SCALES, situations=situations, targets=targets)
    encoded = encode(params, problem, free=path, radius=radius)
    best = enumerated(encoded.program)
    solution = solved(encoded.program)
    np.testing.assert_allclose(solution.incumbent, best, rtol=1e-5, atol=1e-6)
    start = encoded.program.objective(encoded.values_of(params))
    assert best < start - 1e-4
    np.testing.assert_allclose(
        deviation(problem, outputs(problem, encoded.params_of(solution.values))), best, rtol=1e-4, atol=1e-6
    )


def crowded(count: int = 3) -> Situations:
    """Agents beside an obstacle of radius 1 at the origin, drifting into it; sums of radii 1.5."""
    own = np.array([[1.6, 0.2, -1.2, 0.1], [-0.3, 1.7, 0.2, -0.9], [1.3, 1.2, -0.8, -0.6]])[:count]
    places = {"goal": np.array([[3.0, 2.0, 0, 0]]), "obstacle": np.zeros((1, 4)), "agent": np.zeros((0, 4))}
    return Situations(
        own=own,
        senders={name: np.repeat(at[None], count, axis=0) for name, at in places.items()},
        present={name: np.ones((count, len(at)), bool) for name, at in places.items()},
    )


@pytest.mark.parametrize("kind", [Diamond, Polygon])
def test_readout_free_all_sides_tried(kind):
    """Against linear programs over all choices of a side for each row."""
    params, situations = network(), crowded()
    kwargs = {} if kind is Diamond else {"edges": 4}
    problem = problem_of(
        situations, params, constraint=kind(kinematics=KINEMATICS, **kwargs), bodies=BODIES, margin=0.0
    )
    assert (violations(problem, problem.targets) > 0.1).any()
    encoded = encode(params, problem, free="readout/layer0", radius=4.0)
    solution = solved(encoded.program)
    assert solution.status == Status.OPTIMAL
    best = np.inf
    plain = encode(params, problem_of(situations, params), free="readout/layer0", radius=4.0).program
    conditions = problem.conditions
    choices = product(range(4), repeat=len(conditions.row))
    out = plain.blocks["output"]
    for choice in choices:
        rows = [
            columns(out[row]).map(each(1, conditions.normal[k, side, 0][None]))
            for k, (row, side) in enumerate(zip(conditions.row, choice, strict=True))
        ]
        matrix = sparse.csr_array(
            sparse.vstack([plain.matrix, *(sparse.csr_array(_wide(row.matrix, len(plain.cost))) for row in rows)])
        )
        low = np.concatenate([plain.low, [conditions.offset[k, side, 0] for k, side in enumerate(choice)]])
        high = np.concatenate([plain.high, np.full(len(rows), np.inf)])
        one = solve(replace(plain, matrix=matrix, low=low, high=high), solver="highspy")
        best = min(best, one.incumbent if one.status == Status.OPTIMAL else np.inf)
    np.testing.assert_allclose(solution.incumbent, best, rtol=1e-5)
    after = outputs(problem, encoded.params_of(solution.values))
    assert (violations(problem, after) < 1e-5).all()
    slack = problem.constraint.slack(encounters(situations, BODIES), actions_of(problem, after))
    assert slack.min() > -1e-5


def _wide(matrix, width):
    matrix = matrix.copy()
    matrix.resize((matrix.shape[0], width))
    return matrix


@pytest.mark.parametrize("path", ["readout/layer0", "edge/obstacle/layer1", "edge/obstacle/layer0", "node/layer0"])
@pytest.mark.parametrize("kind", [Diamond, Polygon, Barrier])
def test_repaired_weights_keep_the_conditions(path, kind):
    """With the margin, float32 weights do too; starts satisfy every row when elastic."""
    params, situations = network(), crowded()
    kwargs = {"edges": 8} if kind is Polygon else {}
    problem = problem_of(
        situations, params, constraint=kind(kinematics=KINEMATICS, **kwargs), bodies=BODIES, price=100.0
    )
    before = violations(problem, problem.targets)
    encoded = encode(params, problem, free=path, radius=0.6)
    start = encoded.values_of(params)
    assert encoded.program.excess(start) < 1e-9
    limits = Limits(nodes=300)
    solution = solve(encoded.program, solver="highspy", limits=limits, start=start)
    assert solution.status.solved
    out = outputs(problem, encoded.params_of(solution.values))
    short = violations(problem, out)
    assert short.sum() < before.sum()
    slack = solution.values[encoded.program.blocks["slack"]]
    np.testing.assert_allclose(
        deviation(problem, out) + 100 * np.maximum(short + 1e-4 * (slack > 0), 0).sum(),
        solution.incumbent,
        rtol=2e-3,
        atol=2e-3,
    )
    if solution.status != Status.ELASTIC:
        assert short.max() == 0
    if kind is Barrier and path == "readout/layer0":
        assert encoded.program.size["binaries"] == 0


def test_conditions_that_bounds_prove_are_left_out():
    params, situations = network(), crowded()
    far = replace(situations, own=situations.own + np.array([[0.0, 0, 0, 0], [50, 0, 0, 0], [0, 0, 0, 0]]))
    problem = constrained(far, params)
    encoded = encode(params, problem, free="readout/layer0", radius=0.1)
    assert encoded.kept.tolist() == [0, 2]
    assert encode(params, problem, free="readout/layer0", radius=100.0).kept.tolist() == [0, 1, 2]


@pytest.mark.parametrize("kind", [Diamond, Polygon])
def test_infeasible_in_the_box_unless_elastic(kind):
    params, situations = network(), crowded()
    hard = constrained(situations, params, kind)
    assert solved(encode(params, hard, free="readout/layer0", radius=0.01).program).status == Status.INFEASIBLE
    elastic = replace(hard, price=10.0)
    encoded = encode(params, elastic, free="readout/layer0", radius=0.01)
    solution = solved(encoded.program)
    assert solution.status == Status.ELASTIC
    out = outputs(elastic, encoded.params_of(solution.values))
    expected = deviation(elastic, out) + 10 * violations(elastic, out).sum()
    np.testing.assert_allclose(solution.incumbent, expected, rtol=1e-3)


def test_the_executed_action_keeps_the_condition():
    """An output beyond the limit points off the normal once it is clipped; the cone's half-planes forbid that."""
    params, situations = network(), crowded(1)
    situations = replace(situations, own=np.array([[2.6, 0.2, -2.0, 0.1]]))
    kinematics = replace(KINEMATICS, max_speed=1e9)
    constraint = Barrier(kinematics=kinematics)
    needed = constraint.least(encounters(situations, BODIES))[0, 0]
    assert 1 < needed < 4
    sideways = np.array([[2.0, 40.0]])
    common = {"scales": SCALES, "situations": situations, "targets": sideways, "constraint": constraint}
    margins = []
    for limit in (np.inf, 4.0):
        problem = Problem(**common, bodies=BODIES, limit=limit)
        encoded = encode(params, problem, free="readout/layer0", radius=200.0)
        out = outputs(problem, encoded.params_of(solved(encoded.program).values))
        done = executed(situations.own[:, 2:], out, kinematics)
        margins.append(constraint.slack(encounters(situations, BODIES), done).min())
    assert margins[0] < -0.5
    assert margins[1] >= -1e-6


def test_state_change_readout():
    """The author's code: four outputs, the first two the displacement."""
    params = network()
    readout = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    params = params | {"readout": {"layer0": {"kernel": readout, "bias": np.zeros(4, np.float32)}}}
    situations = crowded()
    meaning = state_change(situations, KINEMATICS)
    plain = Problem(scales=SCALES, situations=situations, targets=np.zeros((3, 4)), output=meaning, normalise=False)
    out = outputs(plain, params)
    e = encounters(situations, BODIES)
    after = e.relative[:, 0] + out[:, :2]
    expected = np.abs(after).sum(axis=1) / np.sqrt(2) - 1.5
    constraint = Diamond(kinematics=KINEMATICS)
    np.testing.assert_allclose(constraint.slack(e, actions_of(plain, out))[:, 0], expected, rtol=1e-6)
    problem = replace(plain, targets=out, constraint=constraint, bodies=BODIES)
    encoded = encode(params, problem, free="readout/layer0", radius=5.0)
    solution = solved(encoded.program)
    assert solution.status == Status.OPTIMAL
    repaired = outputs(problem, encoded.params_of(solution.values))
    np.testing.assert_allclose(solution.incumbent, np.abs(repaired - out).sum(axis=1).mean(), rtol=1e-5)
    place = e.relative[:, 0] + repaired[:, :2]
    assert (np.abs(place).sum(axis=1) >= np.sqrt(2) * 1.5 - 1e-6).all()


def test_solvers_agree():
    params, situations = network(), crowded()
    problem = constrained(situations, params, price=20.0)
    program = encode(params, problem, free="edge/obstacle/layer1", radius=0.3).program
    costs = [solve(program, solver=solver).incumbent for solver in installed()]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-3)
    stopped = solve(program, solver="HIGHS", limits=Limits(seconds=0.0))
    assert (stopped.status, stopped.values) == (Status.NO_INCUMBENT, None)


def test_tightened_bounds_are_inside_and_sound():
    params, situations = network(), swarm(1)
    problem = problem_of(situations, params)
    path, radius = "edge/obstacle/layer0", 0.5
    loose = encode(params, problem, free=path, radius=radius)
    tight = encode(params, problem, free=path, radius=radius, tighten=1000)
    shrunk = 0.0
    for name, wide in loose.bounds.items():
        assert (tight.bounds[name].low >= wide.low).all()
        assert (tight.bounds[name].high <= wide.high).all()
        shrunk += float(((wide.high - wide.low) - (tight.bounds[name].high - tight.bounds[name].low)).sum())
    assert shrunk > 0.1
    for seed in range(40):
        other = moved(params, path, 0.4999, seed)
        assert tight.program.excess(tight.values_of(other)) < 1e-9
    costs = [solved(encoded.program).incumbent for encoded in (loose, tight)]
    np.testing.assert_allclose(costs, 0, atol=1e-6)


def test_activated_is_relu():
    chain = chain_of(network(), SCALES, swarm(1), "node/layer0")
    x = intervals(chain, 0.3)["node/layer0"]
    assert activated(chain.steps[0], x).low.min() == 0
    assert activated(chain.steps[-1], x) is x


def test_what_cannot_be_encoded_is_named():
    params, situations = network(), crowded()
    problem = problem_of(situations, params)
    with pytest.raises(SpecError, match="one of readout/layer0, node/layer0, edge/"):
        encode(params, problem, free="node/layer7", radius=0.1)
    with pytest.raises(RepairError, match="nobody sends"):
        encode(params, problem, free="edge/agent/layer0", radius=0.1)
    nan = jax.tree.map(np.array, params)
    nan["node"]["layer0"]["kernel"][0, 0] = np.nan
    with pytest.raises(RepairError, match=r"weights are not all finite.*node/layer0"):
        encode(nan, problem, free="readout/layer0", radius=0.1)
    for radius in (np.inf, 1e308):
        with pytest.raises(Unbounded):
            encode(params, problem, free="node/layer0", radius=radius)
    lost = replace(problem, situations=replace(situations, own=situations.own * np.nan))
    with pytest.raises(Unbounded, match="states"):
        encode(params, lost, free="readout/layer0", radius=0.1)
    with pytest.raises(SpecError, match="radius"):
        encode(params, problem, free="readout/layer0", radius=-1.0)
    with pytest.raises(RepairError, match=r"no finite number of half-planes.*disc"):
        encode(params, constrained(situations, params, Disc), free="readout/layer0", radius=0.1)


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"price": 0.0}, "price"),
        ({"margin": -1.0}, "margin"),
        ({"limit": 0.0}, "limit"),
        ({"bodies": BODIES}, "bodies"),
        ({"targets": np.zeros((2, 2))}, "targets"),
        ({"targets": np.full((3, 2), np.nan)}, "targets"),
    ],
)
def test_problems_are_checked(wrong, what):
    given = {"scales": SCALES, "situations": crowded(), "targets": np.zeros((3, 2))} | wrong
    with pytest.raises((SpecError, RepairError), match=what):
        Problem(**given)


def test_conditions_on_obstacles_alone():
    params, situations = network(), swarm(1, 2)
    everyone = constrained(situations, params)
    assert set(everyone.conditions.body.tolist()) == {0, 1, 2}
    alone = replace(everyone, agents=False)
    assert alone.conditions.body.tolist() == [0] * len(situations)
    np.testing.assert_array_equal(
        violations(alone, alone.targets), violations(everyone, alone.targets)[everyone.conditions.body == 0]
    )


def test_contradictory_conditions():
    """Between two obstacles that leave no room, no box is wide enough."""
    situations = crowded(1)
    both = np.array([[[1.8, 0.2, 0, 0], [1.4, 0.2, 0, 0]]])
    squeezed = replace(
        situations,
        senders=situations.senders | {"obstacle": both},
        present=situations.present | {"obstacle": np.ones((1, 2), bool)},
    )
    problem = constrained(squeezed, network(), Barrier)
    encoded = encode(network(), problem, free="readout/layer0", radius=1000.0)
    assert len(encoded.kept) == 2
    assert solved(encoded.program).status == Status.INFEASIBLE
    assert jnp.isfinite(encoded.program.upper[encoded.program.integer]).all()
