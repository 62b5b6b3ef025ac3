"""Constraints on actions: by hand, against simulation substep by substep, and for what they promise."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_state
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from learning import INTEGRATOR, initial, random_swarm, scales, tiny

from envs.dynamics import limited
from gnn.checkpoint import Model
from gnn.decode import make_policy, network
from gnn.graph import graph_of_state
from repair.config import CONSTRAINTS, ConstraintConfig
from repair.constraints.barrier import Barrier
from repair.constraints.constraint import HalfPlanes
from repair.constraints.diamond import Diamond
from repair.constraints.disc import Disc
from repair.constraints.polygon import Polygon
from repair.constraints.registry import make_constraint
from repair.constraints.roll_out import RollOut
from repair.encounters import Encounters, encounters, gap
from repair.errors import NotEncodable
from repair.limits import as_executed, executed
from repair.network import actions, check_encodable, concatenate, situations_of, situations_of_state
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec


@dataclass(frozen=True)
class Steps:
    """Limits and control step."""

    dt: float = 0.3
    substeps: int = 30
    max_speed: float = 10.0
    max_acceleration: float = 10.0


SPEC = SceneSpec(num_agents=4, num_obstacles=2)
EVERY = [make_constraint(ConstraintConfig(name=name, margin=0.2), Steps()) for name in CONSTRAINTS]


def meeting(relative, velocity, *, reach=8.0, steers=False, present=True) -> Encounters:
    """One body per row."""
    relative, velocity = np.atleast_2d(np.asarray(relative, float)), np.atleast_2d(np.asarray(velocity, float))
    shape = (len(relative), 1)
    return Encounters(
        relative=relative[:, None],
        velocity=velocity[:, None],
        own_velocity=velocity,
        reach=np.full(shape, reach),
        present=np.full(shape, present),
        steers=np.full(shape, steers),
    )


def ahead(h: float, s: float, *, steers: bool = False, present: bool = True) -> Encounters:
    """On the x axis, with a gap h [m] between surfaces and a radial velocity s [m/s]."""
    return meeting([h + 8.0, 0], [s, 0], steers=steers, present=present)


def substeps(h: float, s: float, w: float, steps: Steps, number: int | None = None) -> tuple[float, float, float]:
    """Semi-implicit Euler along the line: gap and speed after them, and the least gap on the way."""
    least, tau = h, steps.dt / steps.substeps
    for _ in range(steps.substeps if number is None else number):
        s += tau * w
        h += tau * s
        least = min(least, h)
    return h, s, least


# The network.


def crowd(seed: int = 0):
    rng = np.random.default_rng(seed)
    return scene_state(
        SPEC,
        rng.uniform(-30, 30, (6, 4, 2)),
        rng.normal(0, 3, (6, 4, 2)),
        goal=rng.uniform(-30, 30, (6, 2)),
        obstacle=rng.uniform(-30, 30, (6, 2, 2)),
        agent_present=np.arange(4) < np.array([4, 4, 3, 1, 4, 2])[:, None],
        obstacle_present=np.arange(2) < np.array([2, 0, 1, 2, 1, 0])[:, None],
    )


def weights_for(state, preset: str = "thesis-ch5") -> dict:
    nodes, graph = graph_of_state(state, goal=True)
    return initial(tiny(preset), scales(), np.asarray(nodes)[:, None], graph)


def test_decisions_are_the_policy_s():
    state, config = crowd(), tiny("thesis-ch5")
    params = weights_for(state)
    policy = np.asarray(make_policy(config, scales())(state, params))
    ours = actions(params, scales(), situations_of_state(state))
    assert ours.dtype == np.float64
    here = np.asarray(state.agent_present)
    np.testing.assert_allclose(ours.reshape(6, 4, 2)[here], policy[here], rtol=1e-5, atol=1e-5)


def test_decisions_without_normalisation_and_obstacles():
    config = replace(tiny("thesis-ch5"), normalise=False)
    history, _, graph = random_swarm(1, (1, 0, 3), absent=0.2)
    params = initial(config, scales(), history, graph)
    theirs = np.asarray(network(config, scales())(params, history, graph)).reshape(-1, 2)
    ours = actions(params, scales(), situations_of(history[:, 0], graph), normalise=False)
    here = np.asarray(graph.present)[:, 1:].ravel()
    np.testing.assert_allclose(ours[here], theirs[here], rtol=1e-5, atol=1e-5)


def test_neighbours_have_no_order_and_jax_agrees():
    state = crowd(3)
    params, s = weights_for(state), situations_of_state(state)
    before = actions(params, scales(), s)
    for name in ("agent", "obstacle"):
        order = np.random.default_rng(0).permutation(s.senders[name].shape[1])
        s = replace(
            s,
            senders=s.senders | {name: s.senders[name][:, order]},
            present=s.present | {name: s.present[name][:, order]},
        )
    np.testing.assert_allclose(actions(params, scales(), s), before, atol=1e-12)
    in_jax = jax.tree.map(lambda x: jnp.asarray(x, jnp.bool_ if x.dtype == bool else jnp.float32), s)
    np.testing.assert_allclose(actions(params, scales(), in_jax), before, rtol=1e-4, atol=1e-5)
    twice = concatenate([s, s.take(slice(0, 3))])
    np.testing.assert_allclose(actions(params, scales(), twice)[-3:], before[:3], atol=1e-12)


def test_what_cannot_be_encoded_is_named():
    def model(name: str) -> Model:
        return Model(tiny(name), scales(), INTEGRATOR, {}, {"preset": name})

    assert check_encodable(model("thesis-ch5")) == tiny("thesis-ch5")
    with pytest.raises(NotEncodable, match=r"preset best cannot be repaired.*frame"):
        check_encodable(model("best"))
    with pytest.raises(NotEncodable, match=r"thesis-ch3.*no acceleration"):
        check_encodable(model("thesis-ch3"))


def test_encounters():
    e = encounters(situations_of_state(crowd()), SPEC)
    state = crowd()
    apart = np.asarray(state.position, np.float64)[0, 1] - np.asarray(state.obstacle, np.float64)[0, 1]
    np.testing.assert_allclose(e.relative[1, 1], apart)
    assert gap(e)[1, 1] == pytest.approx(np.hypot(*apart) - 8)
    assert e.present[1].tolist() == [True, True, True, False, True, True]  # everybody but itself
    assert np.isinf(gap(e)[1, 3])
    assert e.steers[0].tolist() == [False] * 2 + [True] * 4
    np.testing.assert_array_equal(e.reach[0], [8, 8, 2, 2, 2, 2])


# The barrier.


def test_barrier_by_hand():
    # Touching at once after the step at speed 0: (0 - (-3)) / 0.3 = 10 stops within the step, in 3 * 0.3 / 2 = 0.45 m.
    endless = Barrier(kinematics=Steps(substeps=10**6), share=1.0)
    assert endless.least(ahead(0.45, -3.0))[0, 0] == pytest.approx(10, rel=1e-4)
    # Stops within the step from any other speed as well: w = s^2 / (2 h).
    assert endless.least(ahead(0.1, -1.0))[0, 0] == pytest.approx(5, rel=1e-4)
    # Braking already with all there is: 10^2 / (2 * 10) = 5 m.
    assert endless.least(ahead(5.0, -10.0))[0, 0] == pytest.approx(10, rel=1e-4)
    # Far away nothing is needed, however fast: even full throttle towards the body is allowed.
    assert endless.least(ahead(100.0, -10.0))[0, 0] < -10
    assert endless.slack(ahead(5.0, -10.0), np.array([[8.0, 3.0]]))[0, 0] == pytest.approx(-2, rel=1e-4)


def test_barrier_s_margin_pairs_and_absent():
    plain, wide = Barrier(kinematics=Steps()), Barrier(kinematics=Steps(), margin=0.5)
    assert wide.least(ahead(3.5, -6)) == pytest.approx(plain.least(ahead(3.0, -6)))
    # A pair brakes together, each half: as beside a wall with brakes twice as strong.
    both = Barrier(kinematics=Steps(max_acceleration=20.0)).least(ahead(2.0, -6)) / 2
    assert plain.least(ahead(2.0, -6, steers=True)) == pytest.approx(both)
    assert plain.least(ahead(2.0, -6, present=False))[0, 0] == -np.inf
    assert plain.slack(ahead(2.0, -6, present=False), np.zeros((1, 2)))[0, 0] == np.inf
    # 0.2 m inside at rest: after the step of 0.3 s it opens at 0.2 / 0.3 m/s, with w = 0.2 / 0.3^2.
    assert plain.least(ahead(-0.2, 0.0))[0, 0] == pytest.approx(0.2 / 0.09)
    # A body that moves is a body at rest, seen from it.
    state = crowd()
    state = replace(state, obstacle_velocity=np.full((6, 2, 2), 2.0, np.float32))
    still = replace(crowd(), velocity=np.asarray(crowd().velocity) - 2)
    moving, resting = (encounters(situations_of_state(x), SPEC) for x in (state, still))
    np.testing.assert_allclose(plain.least(moving)[:, :2], plain.least(resting)[:, :2], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("k", [30, 1000])
@pytest.mark.parametrize(("h", "s"), [(0.2, -1.0), (1.0, -4.0), (3.0, -6.0), (6.0, -9.0), (4.0, 0.0), (0.4, 1.0)])
def test_barrier_is_the_least_that_can_still_stop(h, s, k):
    """Bisection over w: one step of w, then full braking with b for as long as it takes."""
    steps = Steps(substeps=k)
    b = 0.7 * steps.max_acceleration

    def stops(w: float) -> bool:
        after, speed, least = substeps(h, s, w, steps)
        if speed < 0:
            # Braking in continuous time; in substeps of dt / k, it stops a little later.
            least = min(least, after - speed * speed / (2 * b))
        return least >= 0

    low, high = -100.0, 100.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if stops(middle) else (middle, high)
    assert Barrier(kinematics=steps).least(ahead(h, s))[0, 0] == pytest.approx(high, abs=0.7 / k * abs(high) + 1e-6)


@given(h=st.floats(0.02, 40), s=st.floats(-20, 10), more=st.floats(0, 1))
def test_barrier_can_be_kept_for_ever(h, s, more):
    steps = Steps(substeps=30_000)
    barrier = Barrier(kinematics=steps)
    b, limit = 0.7 * steps.max_acceleration, steps.max_acceleration
    w = float(barrier.least(ahead(h, s))[0, 0])
    assume(w <= b)
    acted = max(w, -limit) + more * (limit - max(w, -limit))
    # Continuous time: the least gap lies at an end of the step or where the speed is 0.
    turn = -s / acted if acted > 0 and 0 < -s / acted < steps.dt else steps.dt
    least = min(h + s * t + acted * t * t / 2 for t in (turn, steps.dt))
    assert least >= -1e-3 * (1 + abs(s))
    after, speed = h + s * steps.dt + acted * steps.dt**2 / 2, s + acted * steps.dt
    assume(after > 1e-3)
    assert barrier.least(ahead(after, speed))[0, 0] <= b * (1 + 1e-2) + 1e-2


@settings(max_examples=40)
@given(h=st.floats(0.05, 30), one=st.floats(-10, 10), other=st.floats(-10, 10))
def test_two_that_give_half_each_never_touch(h, one, other):
    steps = Steps(substeps=60)
    barrier = Barrier(kinematics=steps)
    b = 0.7 * steps.max_acceleration
    own = float(barrier.least(ahead(h, one + other, steers=True))[0, 0])
    assume(own <= b)
    s = one + other
    for _ in range(40):
        own = min(max(float(barrier.least(ahead(h, s, steers=True))[0, 0]), -10.0), 10.0)
        h, s, least = substeps(h, s, 2 * own, steps)
        # Of k substeps each is a little longer than continuous time says: dt / k of what is braked.
        assert least >= -steps.dt / steps.substeps * 2.0


# Shapes around the next position.


def test_slacks_by_hand():
    steps = Steps(substeps=1)
    e, u = meeting([9.0, 0], [-2.0, 3.0]), np.array([[10.0, 0.0]])
    after = np.array([9.0 - 0.6 + 0.9, 0.9])
    assert Disc(kinematics=steps, margin=0.1).slack(e, u)[0, 0] == pytest.approx(np.hypot(*after) - 8.1)
    assert Diamond(kinematics=steps).slack(e, u)[0, 0] == pytest.approx(after.sum() / np.sqrt(2) - 8)
    normals = [[np.cos(a), np.sin(a)] for a in np.pi / 6 * np.array([1, 3, 5, 7, 9, 11])]
    assert Polygon(kinematics=steps, edges=6).slack(e, u)[0, 0] == pytest.approx(max(after @ np.transpose(normals)) - 8)
    # Two published steps: v' = v + a dt, x' = x + v' dt.
    second = after + 0.3 * (np.array([-2.0, 3.0]) + 2 * 0.3 * u[0])
    found = RollOut(kinematics=steps, horizon=2).slack(e, u)[0]
    assert found == pytest.approx([np.hypot(*after) - 8, np.hypot(*second) - 8])


def random_meetings(seed: int, rows: int = 60) -> tuple[Encounters, np.ndarray]:
    rng = np.random.default_rng(seed)
    angle, far = rng.uniform(0, 2 * np.pi, rows), rng.uniform(7.5, 11, rows)
    e = meeting(far[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1), rng.normal(0, 6, (rows, 2)))
    return e, rng.normal(0, 8, (rows, 2))


@pytest.mark.parametrize("constraint", EVERY, ids=CONSTRAINTS)
def test_half_planes_hold_only_what_is_allowed(constraint):
    e, u = random_meetings(0)
    planes = constraint.half_planes(e, u)
    np.testing.assert_allclose(np.linalg.norm(planes.normal, axis=-1), 1)
    for seed in range(40):
        tried = np.random.default_rng(seed).normal(0, 15, u.shape)
        inside = (np.sum(planes.normal * tried[:, None], axis=-1) >= planes.offset).all(axis=1)
        slack = constraint.slack(e, tried).min(axis=1)
        if constraint.name != "roll-out":  # whose conditions are several to a body
            sides = constraint.sides(e)
            if sides is not None:
                beyond = np.sum(sides.normal * tried[:, None, None], axis=-1) - sides.offset
                np.testing.assert_array_equal((beyond >= 0).any(axis=2).all(axis=1), slack >= 0)
        assert (slack[inside] >= -1e-9).all()
    assert constraint.half_planes(replace(e, present=~e.present), u).offset.max() == -np.inf
    assert constraint.slack(replace(e, present=~e.present), u).min() == np.inf


@pytest.mark.parametrize("constraint", EVERY, ids=CONSTRAINTS)
def test_jax_says_the_same(constraint):
    e, u = random_meetings(1)
    cast = jax.tree.map(lambda x: jnp.asarray(x, jnp.bool_ if x.dtype == bool else jnp.float32), e)
    np.testing.assert_allclose(constraint.slack(cast, jnp.asarray(u, jnp.float32)), constraint.slack(e, u), atol=2e-2)
    theirs, ours = constraint.half_planes(cast, jnp.asarray(u, jnp.float32)), constraint.half_planes(e, u)
    if constraint.name not in ("polygon", "diamond"):  # whose edge may be another one where two are as far
        np.testing.assert_allclose(theirs.offset, ours.offset, rtol=1e-3, atol=5e-2)


def test_polygons_are_around_the_disc():
    e, u = random_meetings(2, 500)
    disc, diamond = Disc(kinematics=Steps()), Diamond(kinematics=Steps())
    after = e.relative[:, 0] + 0.3 * e.velocity[:, 0] + diamond.push * u
    np.testing.assert_array_equal(diamond.slack(e, u)[:, 0] >= 0, np.abs(after).sum(axis=1) >= np.sqrt(2) * 8)
    far = np.linalg.norm(after, axis=1, keepdims=True)
    for edges in (4, 8, 32):
        lost = disc.slack(e, u) - Polygon(kinematics=Steps(), edges=edges).slack(e, u)
        assert (lost >= -1e-12).all()
        assert (lost <= far * (1 - np.cos(np.pi / edges)) + 1e-12).all()


@pytest.mark.parametrize("constraint", EVERY, ids=CONSTRAINTS)
def test_turned_scenes(constraint):
    e, u = random_meetings(3)
    quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
    some = 0.7
    turn = np.array([[np.cos(some), np.sin(some)], [-np.sin(some), np.cos(some)]])
    for by in (quarter, turn)[: 1 if constraint.name in ("polygon", "diamond") else 2]:
        turned = replace(e, relative=e.relative @ by, velocity=e.velocity @ by, own_velocity=e.own_velocity @ by)
        np.testing.assert_allclose(constraint.slack(turned, u @ by), constraint.slack(e, u), atol=1e-9)


@pytest.mark.parametrize(
    ("field", "value"), [("name", "ring"), ("margin", -1.0), ("share", 0.0), ("edges", 2), ("horizon", 0)]
)
def test_settings_are_checked(field, value):
    with pytest.raises(SpecError, match=str(value)):
        ConstraintConfig(**{field: value})


def test_a_barrier_needs_brakes():
    with pytest.raises(SpecError, match="max_acceleration"):
        Barrier(kinematics=Steps(max_acceleration=np.inf))


# The executed action.


@given(
    angle=st.floats(0, 2 * np.pi),
    b=st.floats(-15, 9.99),
    u=st.tuples(st.floats(-40, 40), st.floats(-40, 40)),
)
def test_conditions_on_the_clipped_action(angle, b, u):
    u, n = np.array(u), np.array([np.cos(angle), np.sin(angle)])
    planes = as_executed(HalfPlanes(normal=n[None, None], offset=np.array([[b]])), 10.0)
    slack = np.min(planes.normal[0] @ u - planes.offset[0])
    clipped = u * min(1.0, 10.0 / max(np.hypot(*u), 1e-300))
    truly = n @ clipped - b
    assume(abs(slack) > 1e-9 and abs(truly) > 1e-9)
    if b > 0:
        assert (slack >= 0) == (truly >= 0)
    elif slack >= 0:
        assert truly >= 0
    assert as_executed(HalfPlanes(normal=n[None, None], offset=np.array([[b]])), np.inf).offset.shape == (1, 1)


def test_execution_is_the_environment_s():
    rng = np.random.default_rng(0)
    velocity, action = (rng.normal(0, 8, (200, 2)).astype(np.float32) for _ in range(2))
    velocity[:5] = action[5:10] = 0
    np.testing.assert_allclose(
        executed(velocity.astype(np.float64), action.astype(np.float64), Steps()),
        limited(jnp.asarray(velocity), jnp.asarray(action), Steps()),
        atol=2e-5,
    )
