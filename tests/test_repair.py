"""Repair as a whole: linearisation, sequential programs, distillation, the counter-example loop, verification."""

import json
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import cvxpy as cp
import jax
import learning
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from gnn.checkpoint import Model, describe
from gnn.config import PRESETS
from gnn.decode import Integrator
from gnn.freeze import paths_of
from repair.config import ConstraintConfig, DescentConfig, LoopConfig
from repair.constraints.barrier import Barrier
from repair.constraints.constraint import HalfPlanes
from repair.constraints.disc import Disc
from repair.descend import Lessons, Pool
from repair.encounters import encounters
from repair.errors import NotEncodable, RepairError, Status
from repair.limits import executed
from repair.linearise import FreeWeights, Linearised
from repair.loop import repair
from repair.network import Situations, actions, fitted
from repair.relax import Relaxation, SequentialProblem, _factor, relax
from repair.screen import Acted, decisions, least, screen
from repair.verify import clopper_pearson, verify
from swarm_mjcf.errors import SpecError, SwarmError

MOTION = Integrator(dt=0.3, substeps=30, max_speed=10.0, max_acceleration=10.0)
BODIES = SimpleNamespace(agent_radius=1.0, obstacle_radius=3.0)
CONFIG = replace(PRESETS["thesis-ch5"], edge_hidden=(8, 8), message=6, node_hidden=(8, 8))
COUNTS = (1, 1, 2)
READOUT = ("readout/*",)
ALL = ("edge/obstacle/*", "edge/agent/*", "node/*", "readout/*")


def model(preset: str = "thesis-ch5", config=CONFIG) -> Model:
    history, _, graph = learning.random_swarm(3, COUNTS)
    params = learning.initial(config, learning.scales(), history, graph, 3)
    about = {"preset": preset, "data": {}, **describe(config, learning.scales(), MOTION)}
    return Model(config, learning.scales(), MOTION, params, about)


@cache
def approaching(rows: int = 60, seed: int = 0) -> Situations:
    """Agents on their way to an obstacle at the origin, so fast that most have to brake, somebody else far behind."""
    rng = np.random.default_rng(seed)
    angle, distance = rng.uniform(0, 2 * np.pi, rows), rng.uniform(4.5, 9, rows)
    speed = rng.uniform(0.6, 1.0, rows) * np.sqrt(2 * 7 * (distance - 4))
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    own = np.concatenate([outward * distance[:, None], -outward * speed[:, None]], axis=1)
    other = np.concatenate([outward * (distance[:, None] + 40), np.zeros((rows, 2))], axis=1)
    goal = np.concatenate([-outward * 20, np.zeros((rows, 2))], axis=1)
    places = {"goal": goal[:, None], "obstacle": np.zeros((rows, 1, 4)), "agent": np.stack([own, other], axis=1)}
    present = {"goal": np.ones((rows, 1), bool), "obstacle": np.ones((rows, 1), bool)}
    present["agent"] = np.tile([False, True], (rows, 1))
    return Situations(own=own, senders=places, present=present)


def problem(m: Model, constraint=None, rows: int = 60) -> SequentialProblem:
    constraint = constraint or Barrier(kinematics=MOTION)
    situations = approaching(rows)
    judged = screen(constraint, situations, actions(m.params, m.scales, situations), BODIES, MOTION)
    anchors = approaching(80, 1)
    return SequentialProblem(
        scales=m.scales, normalise=True, constraint=constraint, bodies=BODIES, kinematics=MOTION,
        constrained=situations.take(judged.possible & judged.apart), anchors=anchors,
        targets=np.asarray(actions(m.params, m.scales, anchors)),
    )  # fmt: skip


# ---- linearisation -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("patterns", [READOUT, ("edge/obstacle/layer2/*", "node/layer1/bias")])
def test_the_jacobian_is_that_of_finite_differences(patterns):
    m, situations = model(), approaching(7)
    free = FreeWeights.matching(m.params, patterns)
    jacobian = Linearised(free, m.scales, normalise=True).jacobian(m.params, situations)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=free.vector(m.params).size)

    def moved(by: float) -> np.ndarray:
        # In float64: weights are rounded to float32 only when they are kept.
        leaves = iter(
            np.split(free.vector(m.params) + by * direction, np.cumsum([x.size for x in free.leaves(m.params)]))
        )
        flat = [
            next(leaves).reshape(leaf.shape) if chosen else leaf
            for leaf, chosen in zip(jax.tree.leaves(m.params), free.chosen, strict=True)
        ]
        return actions(jax.tree.unflatten(jax.tree.structure(m.params), flat), m.scales, situations)

    slope = (moved(1e-6) - moved(-1e-6)) / 2e-6
    np.testing.assert_allclose(jacobian @ direction, slope, rtol=2e-4, atol=2e-4)


def test_other_weights_stay_and_free_ones_come_back():
    m = model()
    free = FreeWeights.matching(m.params, ("node/*",))
    changed = free.put(m.params, free.vector(m.params) + 1)
    for path, before, after in zip(paths_of(m.params), *map(jax.tree.leaves, (m.params, changed)), strict=True):
        assert after.dtype == np.float32
        assert np.array_equal(before, after) == (not path.startswith("node/"))
    np.testing.assert_allclose(free.vector(changed), free.vector(m.params) + 1, rtol=1e-6)


def test_patterns_and_weights_that_cannot_be_are_refused():
    m = model()
    with pytest.raises(SpecError, match=r"edge/ball"):
        FreeWeights.matching(m.params, ("edge/ball/*",))
    with pytest.raises(SpecError, match="at least one pattern"):
        FreeWeights.matching(m.params, ())
    m.params["readout"]["layer0"]["bias"][0] = np.nan
    with pytest.raises(SpecError, match=r"readout/layer0/bias.*NaN"):
        FreeWeights.matching(m.params, READOUT)


# ---- sequential programs -------------------------------------------------------------------------------------------


def test_the_readout_is_the_optimum_of_the_quadratic_program():
    """Of the last layer, actions are linear: one program, here written out for cvxpy."""
    m = model()
    question, free = problem(m), FreeWeights.matching(m.params, READOUT)
    settings = Relaxation(price=1e3, trust=1e-9, stiffness=1e-3, steps=40)
    found = relax(question, m.params, free, settings)
    assert found.status is Status.FEASIBLE
    jacobian = Linearised(free, m.scales, normalise=True)
    anchored = jacobian.jacobian(m.params, question.anchors).astype(np.float64)
    rows = jacobian.jacobian(m.params, question.constrained).astype(np.float64)
    now = actions(m.params, m.scales, question.constrained)
    planes = question.planes(now)
    change = cp.Variable(anchored.shape[-1])
    deviation = cp.sum_squares(anchored.reshape(-1, change.size) @ change) / len(question.targets)
    real = np.isfinite(planes.offset)
    towards = np.einsum("rcd,rdp->rcp", planes.normal, rows)[real]
    needed = (planes.offset + settings.margin - np.sum(planes.normal * now[:, None], axis=-1))[real]
    objective = 0.5 * deviation + 0.5 * settings.stiffness * cp.sum_squares(change)
    best = cp.Problem(cp.Minimize(objective), [towards @ change >= needed]).solve(solver=cp.CLARABEL)
    assert found.merit == pytest.approx(best, rel=0.02)
    assert found.merit >= best * (1 - 0.01)


@pytest.mark.parametrize(("patterns", "left"), [(("edge/obstacle/layer2/*",), 0.3), (ALL, 0.1)])
def test_hidden_layers_are_repaired_too(patterns, left):
    m = model()
    question, free = problem(m), FreeWeights.matching(m.params, patterns)
    before = question.shortfall(question.act(m.params, question.constrained))
    found = relax(question, m.params, free, Relaxation(price=100.0))
    after = question.shortfall(question.act(found.params, question.constrained))
    assert (before > 1e-3).any(axis=1).sum() > 10
    assert found.violated == (after > 1e-4).any(axis=1).sum()
    assert found.violated <= left * (before > 1e-3).any(axis=1).sum()
    merits = [row["merit"] for row in found.history]
    assert len(merits) > 1


def test_true_discs_are_kept_through_tangents():
    m = model()
    question = problem(m, Disc(kinematics=MOTION, margin=1.0))
    found = relax(question, m.params, FreeWeights.matching(m.params, ALL), Relaxation(price=1e3))
    e = encounters(question.constrained, BODIES)
    before = executed(e.own_velocity, question.act(m.params, question.constrained), MOTION)
    after = executed(e.own_velocity, question.act(found.params, question.constrained), MOTION)
    assert (least(question.constraint, e, before) < 0).sum() > (least(question.constraint, e, after) < -1e-4).sum()


def test_contradictory_rows_are_elastic_and_named_so():
    """The same row cannot go both ways: one body on either side, too near and too fast for both."""
    m = model()
    situations = approaching(1)
    own = np.array([[0.0, 4.5, 0.0, -6.0]])  # towards the obstacle below
    other = np.array([[0.0, 6.6, 0.0, -20.0]])  # and pressed from behind
    pressed = replace(situations, own=own, senders=situations.senders | {"agent": np.stack([own, other], axis=1)})
    question = replace(problem(m), constrained=pressed)
    found = relax(question, m.params, FreeWeights.matching(m.params, READOUT), Relaxation(steps=4))
    assert found.status is Status.ELASTIC
    assert found.violated == 1


@dataclass(frozen=True)
class Lane:
    """The first component between 1 and 1 + `width` m/s^2."""

    width: float
    name = "lane"
    unit = "m/s^2"

    def half_planes(self, e, action) -> HalfPlanes:
        rows = np.ones(len(action))
        normal = np.stack([np.stack([rows, 0 * rows], axis=-1), np.stack([-rows, 0 * rows], axis=-1)], axis=1)
        return HalfPlanes(normal=normal, offset=np.stack([rows, -(1 + self.width) * rows], axis=1))

    def slack(self, e, action):
        planes = self.half_planes(e, action)
        return np.sum(planes.normal * action[:, None], axis=-1) - planes.offset

    def sides(self, e) -> None:
        return None


def test_rows_with_less_room_than_the_margin_are_mended_all_the_same():
    """A margin of 0.02 on both sides does not fit into a lane of 0.01."""
    m = model()
    limitless = replace(MOTION, max_acceleration=np.inf)
    question = replace(problem(m, Lane(0.01)), kinematics=limitless, constrained=approaching(3))
    found = relax(question, m.params, FreeWeights.matching(m.params, READOUT), Relaxation(price=100.0))
    assert found.status is Status.FEASIBLE
    inside = question.act(found.params, question.constrained)[:, 0]
    assert (inside > 1 - 1e-4).all()
    assert (inside < 1.01 + 1e-4).all()


def test_a_time_limit_of_zero_changes_nothing():
    m = model()
    found = relax(problem(m), m.params, FreeWeights.matching(m.params, READOUT), Relaxation(), time_limit=0.0)
    assert found.history == []
    assert found.params is m.params


# ---- screening and verification ------------------------------------------------------------------------------------


def test_screening_tells_avoidable_from_unavoidable():
    one = approaching(3)
    own = np.array([[0.0, 9.0, 0.0, -6.0], [0.0, 4.3, 0.0, -9.0], [0.0, 3.5, 0.0, -1.0]])
    rows = replace(one, own=own)
    inward = np.tile([0.0, -10.0], (3, 1))
    found = screen(Barrier(kinematics=MOTION), rows, inward, BODIES, MOTION)
    assert found.violated.tolist() == [True, True, True]
    assert found.avoidable.tolist() == [True, False, False]  # in time; too fast; inside already
    assert found.apart.tolist() == [True, True, False]
    outward = screen(Barrier(kinematics=MOTION), rows, -inward, BODIES, MOTION)
    assert not outward.violated[0]


def test_decisions_are_those_of_present_agents_in_finite_states():
    acted = drift(np.random.default_rng(0), scenes=3, rows=4)
    acted.graph.present[1, -1] = False
    acted.nodes[2, 1] = np.nan
    situations, where = decisions(acted)
    assert len(situations) == len(where) == 3 * 4 * 2 - 4 - 2
    assert not ((where[:, 0] == 1) & (where[:, 2] == 1)).any()
    assert not ((where[:, 0] == 2) & (where[:, 1] == 1)).any()
    row = int(np.flatnonzero((where == [0, 3, 1]).all(axis=1))[0])
    np.testing.assert_array_equal(situations.own[row], acted.nodes[0, 3, -1].astype(np.float64))


def test_verification_counts_what_is_introduced_and_what_is_mended():
    m = model()
    situations = approaching()
    constraint = Barrier(kinematics=MOTION)
    brakes = jax.tree.map(np.copy, m.params)
    brakes["readout"]["layer0"]["kernel"][:] = 0
    brakes["readout"]["layer0"]["bias"][:] = 0
    found = verify(brakes, m.scales, situations, constraint, BODIES, MOTION, before=m.params)
    e = encounters(situations, BODIES)
    old = least(constraint, e, executed(e.own_velocity, actions(m.params, m.scales, situations), MOTION)) < -1e-4
    new = least(constraint, e, np.zeros((60, 2))) < -1e-4
    assert (found.violated, found.introduced, found.mended) == (new.sum(), (new & ~old).sum(), (old & ~new).sum())
    assert found.rows == 60
    assert not found.holds_as_executed
    assert json.loads(json.dumps(found.plain()))["avoidable"] == found.avoidable


def test_weights_that_are_not_numbers_break_everything():
    m = model()
    m.params["readout"]["layer0"]["bias"][:] = np.nan
    slow = replace(approaching(), own=approaching().own * [1, 1, 0, 0])  # nobody moves: any action would do
    still = np.zeros((len(slow), 2))
    assert not screen(Disc(kinematics=MOTION), slow, still, BODIES, MOTION).violated.any()
    found = verify(m.params, m.scales, slow, Disc(kinematics=MOTION), BODIES, MOTION)
    assert (found.violated, found.avoidable, found.violated_before_clip) == (60, 60, 60)
    assert not found.holds_as_executed
    assert json.loads(json.dumps(found.plain(), allow_nan=False))["worst"] is None


@given(st.integers(0, 40), st.integers(1, 40))
def test_clopper_pearson_is_the_exact_interval(hits, more):
    trials = hits + more
    low, high = clopper_pearson(hits, trials)
    assert 0 <= low <= hits / trials <= high <= 1
    if hits:
        assert scipy.stats.binom.sf(hits - 1, trials, low) == pytest.approx(0.025, rel=1e-6)
        assert scipy.stats.binom.cdf(hits, trials, high) == pytest.approx(0.025, rel=1e-6)
    else:
        assert (1 - high) ** trials == pytest.approx(0.05)


def test_none_of_a_thousand_is_at_most_three_in_a_thousand():
    assert clopper_pearson(0, 1000)[1] == pytest.approx(0.00299, abs=1e-5)


# ---- the loop ------------------------------------------------------------------------------------------------------


def drift(rng: np.random.Generator, scenes: int = 16, rows: int = 6, params=None, m: Model | None = None) -> Acted:
    """Physics without contacts: free flight of two agents towards an obstacle; touching by geometry."""
    _, _, graph = learning.random_swarm(0, COUNTS, batch=scenes)
    graph = jax.tree.map(lambda x: np.array(x), graph)
    nodes = np.zeros((scenes, rows + 1, 4, 4), np.float32)
    angle = rng.uniform(0, 2 * np.pi, (scenes, 2)) + np.array([0, np.pi])
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    nodes[:, :, 0, :2] = 15 * outward[:, None, 0]
    nodes[:, 0, 2:, :2] = rng.uniform(7, 12, (scenes, 2, 1)) * outward
    nodes[:, 0, 2:, 2:] = -rng.uniform(1, 6, (scenes, 2, 1)) * outward
    for t in range(rows):
        state = nodes[:, t, 2:].astype(np.float64)
        u = np.zeros((scenes, 2, 2))
        if params is not None and m is not None:
            alone = Acted(
                nodes=nodes[:, t : t + 2], graph=graph, touching_agent=np.zeros((scenes, 1, 2), bool),
                touching_obstacle=np.zeros((scenes, 1, 2), bool),
            )  # fmt: skip
            wanted = actions(params, m.scales, decisions(alone)[0])
            u = executed(state[..., 2:].reshape(-1, 2), wanted, MOTION).reshape(scenes, 2, 2)
        nodes[:, t + 1, 2:, :2] = state[..., :2] + 0.3 * state[..., 2:] + 0.0465 * u
        nodes[:, t + 1, 2:, 2:] = state[..., 2:] + 0.3 * u
    touching = np.linalg.norm(nodes[:, 1:, 2:, :2], axis=-1) < 4.0
    return Acted(nodes=nodes, graph=graph, touching_agent=np.zeros_like(touching), touching_obstacle=touching)


def performing(m: Model):
    return lambda params, number: drift(np.random.default_rng(number), params=params, m=m)


SMALL = LoopConfig(
    free=ALL, rounds=2, scenes=16, steps=6, lessons=200, pool=800, hard=40, anchors=60,
    descent=DescentConfig(steps=500, batch=64),
)  # fmt: skip


def test_the_loop_mends_what_it_finds():
    m = model()
    kept = jax.tree.map(np.copy, m.params)
    found = repair(m, SMALL, BODIES, performing(m))
    first, last = found.history[0], next(row for row in found.history if row["round"] == found.best)
    assert first["avoidable"] > 0.05
    assert last["avoidable"] < 0.3 * first["avoidable"]
    assert found.verification.rows == len(found.rows)
    assert (found.status is Status.FEASIBLE) == (found.verification.avoidable == 0)
    for path, before, given_, after in zip(
        paths_of(m.params), *map(jax.tree.leaves, (kept, m.params, found.params)), strict=True
    ):
        np.testing.assert_array_equal(before, given_)
        if path.startswith("edge/goal"):
            np.testing.assert_array_equal(before, after)


def test_quadratic_programs_alone_mend_too():
    m = model()
    how = replace(SMALL, method="relax", free=("edge/obstacle/layer2/*", "readout/*"), polish=(), rounds=1)
    found = repair(m, how, BODIES, performing(m))
    assert found.history[1]["avoidable"] < 0.7 * found.history[0]["avoidable"]


class Stopped(Exception):
    pass


@pytest.mark.parametrize("after", [1, 2])
def test_a_repair_that_was_killed_goes_on_to_the_same_weights(after, tmp_path):
    m = model()
    whole = repair(m, SMALL, BODIES, performing(m), folder=tmp_path / "whole")
    calls = 0

    def dying(params, number):
        nonlocal calls
        calls += 1
        if calls > after:
            raise Stopped
        return performing(m)(params, number)

    with pytest.raises(Stopped):
        repair(m, SMALL, BODIES, dying, folder=tmp_path / "cut")
    again = repair(m, SMALL, BODIES, performing(m), folder=tmp_path / "cut")
    for one, other in zip(jax.tree.leaves(whole.params), jax.tree.leaves(again.params), strict=True):
        np.testing.assert_array_equal(one, other)
    assert whole.verification == again.verification
    assert [row["contact_steps"] for row in whole.history] == [row["contact_steps"] for row in again.history]


def test_the_penalty_method_holds_on_to_the_policy_s_own_actions():
    m = model()
    free_of_charge = replace(SMALL, targets="own", polish=(), rounds=1, descent=DescentConfig(steps=250, price=0.0))
    found = repair(m, free_of_charge, BODIES, performing(m))
    assert found.history[0]["deviation"] < 1e-2


def test_a_full_pool_lets_the_oldest_go():
    pool = Pool(5)
    for start in (0, 3, 6):
        situations = jax.tree.map(lambda x, s=start: x[s : s + 3], approaching(10))
        pool.add(Lessons(situations=situations, target=np.full((3, 2), float(start)), bound=np.ones(3, bool)))
    assert pool.count == 5
    assert sorted(pool.lessons.target[:, 0].tolist()) == [3, 3, 6, 6, 6]


def test_other_networks_are_refused_by_name():
    best = learning.tiny("best")
    with pytest.raises(NotEncodable, match=r"preset best cannot be repaired.*frame"):
        repair(model("best", best), SMALL, BODIES, lambda params, number: pytest.fail("nothing should act"))


def test_a_descent_that_diverges_says_so_and_changes_nothing():
    m = model()
    kept = jax.tree.map(np.copy, m.params)
    wild = replace(SMALL, descent=DescentConfig(steps=250, batch=16, learning_rate=1e30))
    with pytest.raises(RepairError, match="diverged"):
        repair(m, wild, BODIES, performing(m))
    for one, other in zip(jax.tree.leaves(kept), jax.tree.leaves(m.params), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: LoopConfig(rounds=-1), "rounds"),
        (lambda: LoopConfig(reserve_share=0.0), "reserve_share"),
        (lambda: LoopConfig(reserve_margin=-1.0), "reserve_margin"),
        (lambda: LoopConfig(hard=0), "hard"),
        (lambda: LoopConfig(price=-1.0), "price"),
        (lambda: LoopConfig(price=float("nan")), "price"),
        (
            lambda: LoopConfig(method="thesis", constraint=ConstraintConfig(name="disc")),
            "barrier or polygon or diamond",
        ),
        (lambda: LoopConfig(method="last-layer"), "disc with method last-layer"),
        (lambda: LoopConfig(box=-1.0), "box"),
        (lambda: ConstraintConfig(name="wall"), "constraint"),
        (lambda: ConstraintConfig(share=1.5), "share"),
        (lambda: ConstraintConfig(margin=float("nan")), "margin"),
        (lambda: DescentConfig(learning_rate=0.0), "learning_rate"),
        (lambda: DescentConfig(price=float("inf")), "price"),
        (lambda: DescentConfig(steps=0), "steps"),
    ],
)
def test_settings_out_of_range_are_named(make, field):
    with pytest.raises(SpecError, match=field):
        make()


@pytest.mark.parametrize(("method", "name"), [("thesis", "diamond"), ("thesis", "polygon"), ("last-layer", "disc")])
def test_methods_of_one_step_mend_the_states_they_took(method, name):
    m = model()
    constraint = ConstraintConfig(name=name, margin=0.5)
    how = LoopConfig(method=method, constraint=constraint, scenes=16, steps=6, states=60, box=2.0, solver_seconds=20.0)
    found = repair(m, how, BODIES, performing(m))
    assert found.verification.mended > 0
    assert found.verification.introduced == 0
    assert [row["round"] for row in found.history] == [0, 1]
    assert found.gap is not None
    for path, before, after in zip(paths_of(m.params), *map(jax.tree.leaves, (m.params, found.params)), strict=True):
        assert path.startswith("readout/") or np.array_equal(before, after)


def test_a_damaged_round_is_named(tmp_path):
    m = model()
    repair(m, SMALL, BODIES, performing(m), folder=tmp_path)
    for left in (b"PK nothing", b""):
        (tmp_path / "round-01.npz").write_bytes(left)
        with pytest.raises(SwarmError, match=r"round-01.npz: is damaged"):
            repair(m, SMALL, BODIES, performing(m), folder=tmp_path)


def test_counter_examples_from_elsewhere_are_learned_and_constrained():
    """Two obstacles where the scenes have room for one each; a neighbour's place is missing and filled up."""
    m = model()
    lone = approaching(50, 5)
    lone = replace(
        lone,
        senders={name: x[:, :1] for name, x in lone.senders.items()},
        present={name: x[:, :1] for name, x in lone.present.items()},
    )
    found = repair(m, SMALL, BODIES, performing(m), examples=lone)
    without = repair(m, SMALL, BODIES, performing(m))
    full = fitted(lone, without.rows)
    assert len(found.rows) > len(without.rows)
    assert full.present["agent"].shape[1:] == without.rows.present["agent"].shape[1:]

    def broken(params: dict) -> int:
        action = actions(params, m.scales, full)
        return int(screen(Barrier(kinematics=MOTION), full, action, BODIES, MOTION).avoidable.sum())

    assert broken(m.params) > 10
    assert broken(found.params) <= broken(without.params)
    assert broken(found.params) < 0.2 * broken(m.params)


def test_more_bodies_than_places_are_refused():
    one, two = approaching(2), approaching(2)
    places, here = np.zeros((2, 2, 4)), np.ones((2, 2), bool)
    crowded = replace(two, senders=two.senders | {"obstacle": places}, present=two.present | {"obstacle": here})
    with pytest.raises(NotEncodable, match="more than 1 places of type obstacle"):
        fitted(crowded, one)


@pytest.mark.parametrize(("method", "name"), [("thesis", "diamond"), ("last-layer", "disc")])
def test_without_a_solution_the_status_says_so_and_the_weights_are_the_given_ones(method, name):
    """No time at all, and for the thesis's method a solver without a start."""
    how = LoopConfig(
        method=method, constraint=ConstraintConfig(name=name, margin=0.5), scenes=16, steps=6, states=60,
        solver="HIGHS", solver_seconds=0.0,
    )  # fmt: skip
    m = model()
    found = repair(m, how, BODIES, performing(m))
    assert found.status == Status.NO_INCUMBENT
    assert found.gap is None
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(m.params), found.params)


def test_what_could_have_been_avoided_does_not_depend_on_what_was_done():
    """Near the speed limit the allowed action that is nearest to the second one is bent by the clip of the speed into
    one that is not allowed: then others are tried."""
    motion = Integrator(dt=0.3, substeps=15, max_speed=10.0, max_acceleration=5.0)
    own = np.array([[-1.54146, -1.28783, 6.58235, -7.44677]])
    still = {"obstacle": np.zeros((1, 1, 4)), "agent": np.zeros((1, 1, 4)), "goal": np.zeros((1, 1, 4))}
    there = {"obstacle": np.ones((1, 1), bool), "agent": np.zeros((1, 1), bool), "goal": np.zeros((1, 1), bool)}
    state, bodies = (
        Situations(own=own, senders=still, present=there),
        SimpleNamespace(agent_radius=1.0, obstacle_radius=1.0),
    )
    for action in ([4.066, 4.095], [2.432, 0.588]):
        judged = screen(Barrier(kinematics=motion), state, np.array([action]), bodies, motion)
        assert judged.violated.all()
        assert judged.avoidable.all(), action


def test_products_that_rounding_made_indefinite_are_factored_with_a_larger_ridge():
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(20, 60)).astype(np.float32) * 30
    gram = (flat.T @ flat).astype(np.float64)
    assert np.linalg.eigvalsh(gram).min() < -1e-6
    lower = _factor(gram, 1e-7)
    whole = lower @ lower.T
    np.testing.assert_allclose(whole, gram, atol=64 * np.finfo(np.float32).eps * np.trace(gram))
    # As asked, where that is enough.
    np.testing.assert_allclose(_factor(np.eye(3), 0.5), np.sqrt(1.5) * np.eye(3))
    with pytest.raises(RepairError, match="not finite"):
        _factor(np.full((2, 2), np.nan), 1.0)
