"""Certificates: bounds that no state beats, shares that sum to 1, proofs and counter-examples known by hand."""

import copy
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learning import scales

from gnn.checkpoint import Checkpoints, describe
from gnn.config import ModelConfig
from gnn.decode import Integrator
from gnn.features import Scales
from repair.certify import Effort, _Found, _judged, _needs, certify
from repair.constraints.barrier import Barrier
from repair.encounters import encounters
from repair.errors import NotEncodable, RepairError
from repair.limits import executed
from repair.network import actions
from repair.propagate import chain_of, lower_forms
from repair.ring import Box, Region, Ring
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec
from swarmnet.commands.certify import run, unpacked
from swarmnet.config_repair import Certify

MOTION = Integrator(dt=0.3, substeps=30, max_speed=6.0, max_acceleration=5.0)
BODIES = SceneSpec(agent_radius=1.0, obstacle_radius=3.0)
REACH = 4.0
SEEDS = st.integers(0, 10**6)
UNITS = Scales.ones()


def random_network(seed: int, *, hidden: int = 7, edge_layers: int = 2, node_layers: int = 2) -> dict:
    """Weights of the thesis-ch5 kind, biases included."""
    rng = np.random.default_rng(seed)

    def part(sizes: list[int]) -> dict:
        return {
            f"layer{i}": {
                "kernel": rng.normal(0, a**-0.5, (a, b)).astype(np.float32),
                "bias": rng.normal(0, 0.3, b).astype(np.float32),
            }
            for i, (a, b) in enumerate(pairwise(sizes))
        }

    kinds = ("goal", "obstacle", "agent")
    return {
        "edge": {kind: part([8] + [hidden] * edge_layers + [5]) for kind in kinds},
        "node": part([9] + [hidden + 1] * node_layers),
        "readout": part([hidden + 1 if node_layers else 9, 2]),
    }


def exact_network(law: np.ndarray, bias: np.ndarray) -> dict:
    """A network whose action is `own @ law + bias` exactly, by pairs of ReLUs; deaf to its senders."""
    pairs = np.concatenate([np.eye(4), -np.eye(4)], axis=1)
    node = np.concatenate([pairs, np.zeros((1, 8))])
    silent = {
        "layer0": {"kernel": np.zeros((8, 2)), "bias": np.zeros(2)},
        "layer1": {"kernel": np.zeros((2, 1)), "bias": np.zeros(1)},
    }
    return {
        "edge": {"goal": silent, "obstacle": silent, "agent": silent},
        "node": {"layer0": {"kernel": node, "bias": np.zeros(8)}},
        "readout": {"layer0": {"kernel": np.concatenate([law, -law]), "bias": bias}},
    }


def a_ring(depth: float = 6.0, *, share: float = 0.7, margin: float = 0.0, neighbour: Box | None = None) -> Ring:
    region = Region(obstacle=(2.0, -1.0), depth=depth, goal=Box.around((20.0, 3.0), (1.0, 1.0)), neighbour=neighbour)
    return Ring(region=region, barrier=Barrier(kinematics=MOTION, share=share, margin=margin), bodies=BODIES)


def drawn(ring: Ring, count: int, seed: int = 0) -> np.ndarray:
    """Points of the ring, uniform in its volume."""
    rng = np.random.default_rng(seed)
    low, high = ring.range
    points = rng.uniform(low, high, (count, len(low)))
    points[:, 0] = np.sqrt(rng.uniform(low[0] ** 2, high[0] ** 2, count))
    speed, turn = MOTION.max_speed * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    points[:, 2], points[:, 3] = speed * np.cos(turn), speed * np.sin(turn)
    return points


def slack_of(params: dict, ring: Ring, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the executed action, and whether some action keeps the barrier: the definition itself."""
    rows = ring.situations(points)
    around = encounters(rows, BODIES)
    action = executed(rows.own[:, 2:], actions(params, UNITS, rows), MOTION)
    return ring.barrier.slack(around, action)[:, 0], ring.barrier.least(around)[:, 0] <= MOTION.max_acceleration


def total(certificate) -> float:
    return certificate.proven + certificate.refuted + certificate.undecided + certificate.unavoidable


# --- bounds ---


@settings(max_examples=12)
@given(seed=SEEDS, node_layers=st.integers(0, 3), edge_layers=st.integers(1, 3), radius=st.floats(0.01, 3))
def test_no_state_of_a_random_network_beats_its_bounds(seed: int, node_layers: int, edge_layers: int, radius: float):
    params = random_network(seed, node_layers=node_layers, edge_layers=edge_layers)
    ring = a_ring(neighbour=Box(low=(-1.0, 0.0, -1.0, 0.0), high=(1.0, 2.0, 1.0, 1.0)))
    chain, units = chain_of(params, scales(), ring.region.kinds), scales()
    rng = np.random.default_rng(seed)
    sets, inputs, coordinates = 6, 16, 5
    centre = rng.normal(0, 4, (sets, inputs))
    generators = radius * rng.normal(0, 1, (sets, coordinates, inputs))
    generators[:, :, 8:12] = 0  # the obstacle stays
    functionals = rng.normal(0, 1, (sets, 3, 2))
    forms = lower_forms(chain, centre, generators, functionals, chunk=4)
    z = rng.uniform(-1, 1, (400, sets, coordinates))
    z[:100] = np.sign(z[:100])
    x = centre + np.einsum("psk,ski->psi", z, generators)
    here = dict.fromkeys(("goal", "obstacle", "agent"), np.ones((len(z) * sets, 1), bool))
    flat = x.reshape(-1, inputs)
    senders = {name: flat[:, None, 4 * i : 4 * i + 4] for i, name in enumerate(here, start=1)}
    rows = ring.situations(np.zeros((1, 10)))
    rows = replace(rows, own=flat[:, :4], senders=senders, present=here)
    u = actions(params, units, rows).reshape(len(z), sets, 2)
    values = np.einsum("psd,smd->psm", u, functionals)
    on = forms.constant + np.einsum("smk,psk->psm", forms.coefficients, z)
    assert (values >= on - 1e-9).all()
    assert (values >= forms.least - 1e-9).all()


def test_bounds_of_a_point_and_of_a_linear_network_are_exact():
    rng = np.random.default_rng(3)
    centre, generators = rng.normal(0, 4, (50, 12)), rng.normal(0, 1, (50, 6, 12))
    both = np.broadcast_to(np.concatenate([np.eye(2), -np.eye(2)]), (50, 4, 2))
    forms = lower_forms(chain_of(random_network(5), scales(), ("goal", "obstacle")), centre, 0 * generators, both)
    np.testing.assert_allclose(forms.least[:, :2], -forms.least[:, 2:], atol=1e-7)

    law, bias = rng.normal(0, 1, (4, 2)), np.array([0.5, -2.0])
    # ReLUs that are always on: both of a pair then pass x, so the law counts twice and the lift cancels.
    params = exact_network(law, bias)
    params["node"]["layer0"]["bias"] = params["node"]["layer0"]["bias"] + 1e3
    forms = lower_forms(chain_of(params, UNITS, ("goal", "obstacle"), normalise=False), centre, generators, both)
    middle, spread = 2 * centre[:, :4] @ law + bias, 2 * np.abs(generators[:, :, :4] @ law).sum(axis=1)
    np.testing.assert_allclose(forms.least[:, :2], middle - spread, atol=1e-8)
    np.testing.assert_allclose(-forms.least[:, 2:], middle + spread, atol=1e-8)


@settings(max_examples=20)
@given(seed=SEEDS)
def test_the_sets_of_cells_hold_every_state_of_them(seed: int):
    ring = a_ring(neighbour=Box(low=(-1.0, 0.0, -1.0, 0.0), high=(1.0, 2.0, 1.0, 1.0)))
    rng = np.random.default_rng(seed)
    low, high = ring.start()
    low, high = low[some := rng.integers(0, len(low), 5)], high[some]
    points = rng.uniform(low, high, (200, *low.shape))
    points[:32] = np.where(rng.random((32, *low.shape)) < 0.5, low, high)
    centre, generators = ring.sets(low, high)
    # The support function in many directions: a point outside the zonotope shows in some of them.
    rows = ring.situations(points.reshape(-1, low.shape[1]))
    x = np.concatenate([rows.own, *(rows.senders[name][:, 0] for name in ("goal", "obstacle", "agent"))], axis=1)
    x = x.reshape(200, 5, 16)
    for direction in rng.normal(0, 1, (60, 16)):
        reach = np.abs(generators @ direction).sum(axis=1)
        assert (np.abs((x - centre) @ direction) <= reach + 1e-9).all()


# --- the barrier ---


@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
def test_the_least_acceleration_falls_in_distance_and_in_radial_velocity_and_is_convex_in_each_kind(share: float):
    ring = a_ring(share=share, margin=0.5)
    rng = np.random.default_rng(0)
    count = 200_000
    inside = rng.random(count) < 0.3
    d = np.where(inside, rng.uniform(REACH, REACH + 0.5, count), REACH + 0.5 + 1e-5 + rng.exponential(1, count))
    s = rng.uniform(-6, 6, count)
    w, step = ring.least(d, s), rng.exponential(0.3, count)
    further = np.where(inside, np.minimum(d + step, REACH + 0.5), d + step)
    assert (ring.least(further, s) <= w + 1e-9).all()
    assert (ring.least(d, s + step) <= w + 1e-9).all()
    other = rng.permutation(count)
    same = ring.kind(d, s) == ring.kind(d[other], s[other])
    assert same.mean() > 0.3
    middle, chord = ring.least((d + d[other]) / 2, (s + s[other]) / 2), (w + w[other]) / 2
    assert (middle <= chord + 1e-7 * (1 + np.abs(chord)))[same].all()


def test_volumes_are_those_of_the_disc_of_velocities_times_the_ring():
    ring = a_ring(margin=0.5)
    low, high = ring.start((3, 5, 4, 7))
    whole = np.pi * ((REACH + 6) ** 2 - REACH**2) * np.pi * 6**2
    assert ring.volume(low, high).sum() == pytest.approx(whole, rel=1e-5)
    corner = ring.volume(np.array([[5, 0, 3, 3, 19, 2.0]]), np.array([[6, 1, 6, 6, 21, 4.0]]))
    s = np.linspace(3, np.sqrt(27), 100_001)
    under = np.trapezoid(np.sqrt(36 - s**2) - 3, s)
    assert corner[0] == pytest.approx((36 - 25) / 2 * under, rel=1e-6)


# --- certificates ---

QUICK = Effort(seconds=60.0, cells=20_000, finest=32)


def braking(strength: float = 40.0) -> dict:
    """Accelerates away from where the obstacle of `a_ring` is, far above the limit: clipped, that is full force."""
    law = np.zeros((4, 2))
    law[:2] = np.eye(2) * strength
    return exact_network(law, -strength * np.array([2.0, -1.0]))


def test_full_force_outward_is_proven_but_for_what_is_too_late():
    found = certify(braking(), UNITS, a_ring(), effort=QUICK)
    assert total(found) == pytest.approx(1)
    assert found.refuted == 0
    assert len(found.slack) == 0
    assert found.unavoidable > 0.04
    assert found.undecided < 0.03
    assert found.proven > found.harmless > 0.3


def test_full_force_inward_is_refuted_where_it_matters():
    found = certify(braking(-40.0), UNITS, a_ring(), effort=QUICK)
    assert total(found) == pytest.approx(1)
    assert found.refuted > 0.3 * found.contested
    assert found.proven < found.harmless + 0.1 * found.contested
    rows = found.counter_examples
    around = encounters(rows, BODIES)
    action = executed(rows.own[:, 2:], actions(braking(-40.0), UNITS, rows), MOTION)
    barrier = a_ring().barrier
    np.testing.assert_allclose(barrier.slack(around, action)[:, 0], found.slack)
    assert (found.slack < 0).all()
    assert (np.diff(found.slack) >= 0).all()
    assert (barrier.least(around)[:, 0] <= MOTION.max_acceleration).all()


@pytest.mark.parametrize("strength", [40.0, -40.0])
def test_shares_are_those_of_states_drawn_at_random(strength: float):
    ring, params = a_ring(), braking(strength)
    found = certify(params, UNITS, ring, effort=QUICK)
    points = drawn(ring, 40_000)
    slack, possible = slack_of(params, ring, points)
    noise = 0.01
    every = certify(braking(0.0), UNITS, ring, effort=Effort(cells=0)).harmless
    w, s = ring.least(points[:, 0], points[:, 2]), points[:, 2]
    free = (w <= -MOTION.max_acceleration) | (s + MOTION.dt * w <= -MOTION.max_speed)
    assert found.harmless == every == pytest.approx(free.mean(), abs=noise)
    assert found.contested == pytest.approx((possible & ~free).mean(), abs=noise)
    assert found.unavoidable <= (~possible).mean() + noise
    assert found.proven <= (possible & (slack >= 0)).mean() + noise
    assert found.unavoidable + found.undecided >= (~possible).mean() - noise
    assert found.proven + found.undecided >= (possible & (slack >= 0)).mean() - noise


def test_a_policy_that_fails_in_one_sector_has_its_counter_examples_there_and_is_proven_elsewhere():
    ring, params = a_ring(), braking()
    # Beyond x = 7.5, 5.5 m to the right of the obstacle, it turns round.
    node, readout = params["node"]["layer0"], params["readout"]["layer0"]
    node["kernel"] = np.concatenate([node["kernel"], np.eye(5)[:, :1]], axis=1)
    node["bias"] = np.append(node["bias"], -7.5)
    readout["kernel"] = np.concatenate([readout["kernel"], [[-4000.0, 0.0]]])
    found = certify(params, UNITS, ring, effort=QUICK)
    assert len(found.slack) > 100
    assert (found.counter_examples.own[:, 0] > 7.5).all()
    points = drawn(ring, 40_000)
    slack, possible = slack_of(params, ring, points)
    bad = (possible & (slack < 0)).mean()
    assert 0.01 < bad < 0.1
    assert found.proven + found.unavoidable > 1 - 3 * bad - 0.05


@settings(max_examples=6)
@given(seed=SEEDS, margin=st.sampled_from([0.0, 0.4]))
def test_no_state_contradicts_a_proven_or_a_violated_cell(seed: int, margin: float):
    rng = np.random.default_rng(seed)
    params = random_network(seed)
    params["readout"]["layer0"]["kernel"] *= np.float32(rng.choice([0.5, 2.0, 8.0]))
    ring = a_ring(depth=3.0, margin=margin)
    cells = 400
    size = rng.choice([0.02, 0.1], (cells, 1)) * (ring.range[1] - ring.range[0])
    low = rng.uniform(ring.range[0], ring.range[1] - size)
    low, high = ring.within(low, low + size)
    straddles = (low[:, 0] < REACH + margin) != (high[:, 0] < REACH + margin)
    needs = _needs(ring, low, high)
    fit = (needs.least.max(axis=1) <= MOTION.max_acceleration) & ~straddles
    low, high = low[fit], high[fit]
    verdict = _judged(chain_of(params, UNITS, ring.region.kinds), ring, low, high, _needs(ring, low, high))
    points = rng.uniform(low, high, (60, *low.shape))
    points[:16] = np.where(rng.random((16, *low.shape)) < 0.5, low, high)
    slack, _ = slack_of(params, ring, points.reshape(-1, low.shape[1]))
    slack = np.where(np.hypot(points[..., 2], points[..., 3]) <= MOTION.max_speed, slack.reshape(60, -1), np.nan)
    assert verdict.proven.any()
    assert (np.nan_to_num(slack[:, verdict.proven], nan=1.0) >= 0).all()
    assert (np.nan_to_num(slack[:, verdict.violated], nan=-1.0) < 0).all()
    assert not (verdict.proven & verdict.violated).any()


def test_without_time_everything_is_undecided():
    for effort in (Effort(seconds=0.0), Effort(cells=0)):
        found = certify(braking(), UNITS, a_ring(), effort=effort)
        assert found.undecided == pytest.approx(1)
        assert found.cells == found.proven == found.refuted == found.unavoidable == len(found.slack) == 0
        assert found.counter_examples.own.shape == (0, 4)


def test_more_cells_decide_more_and_the_same_cells_the_same():
    said = []
    params, ring = random_network(1), a_ring(neighbour=Box.around((9.0, 0.0, 0.0, 0.0), (0.5, 0.5, 1.0, 1.0)))
    params["readout"]["layer0"]["kernel"] *= 4
    few, again, more = (
        certify(
            params, UNITS, ring, effort=Effort(cells=cells, batch=700, examples=50),
            update=lambda done, total, note: said.append((done, total, note)),
        )
        for cells in (2000, 2000, 6000)
    )  # fmt: skip
    assert few.cells == 2000
    assert (few.proven, few.refuted, few.undecided) == (again.proven, again.refuted, again.undecided)
    np.testing.assert_array_equal(few.counter_examples.own, again.counter_examples.own)
    assert more.undecided < few.undecided < 1
    assert total(more) == pytest.approx(1)
    assert 0 < len(few.slack) <= 50
    assert few.counter_examples.senders["agent"].shape[1:] == (1, 4)
    assert all(0 <= done <= total == 1000 for done, total, _ in said)


def test_what_cannot_be_certified_is_refused_by_name():
    broken = copy.deepcopy(random_network(0))
    broken["edge"]["goal"]["layer1"]["kernel"][2, 3] = np.nan
    with pytest.raises(RepairError, match="edge/goal/layer1/kernel"):
        certify(broken, UNITS, a_ring())
    without = random_network(0)
    del without["edge"]["agent"]
    with pytest.raises(NotEncodable, match="agent"):
        certify(without, UNITS, a_ring(neighbour=Box.around((9.0, 0.0, 0.0, 0.0), (0.5, 0.5, 1.0, 1.0))))
    with pytest.raises(SpecError, match="max_speed"):
        Ring(region=Region(), barrier=Barrier(kinematics=replace(MOTION, max_speed=float("inf"))), bodies=BODIES)
    with pytest.raises(SpecError, match="margin"):
        a_ring(depth=1.0, margin=1.0)
    with pytest.raises(SpecError, match="depth"):
        Region(depth=0.0)
    with pytest.raises(SpecError, match="box"):
        Box(low=(1.0,), high=(0.0,))
    with pytest.raises(SpecError, match="seconds"):
        Effort(seconds=-1.0)


# --- the command ---


def test_the_command_writes_a_certificate_and_counter_examples(tmp_path: Path, capsys):
    config = ModelConfig(normalise=True, edge_hidden=(7, 7), message=5, node_hidden=(8, 8))
    about = {"preset": "thesis-ch5", "data": {"simulate": {"preset": "clear"}}, **describe(config, scales(), MOTION)}
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    params = random_network(2)
    checkpoints.save(1, {"params": {k: _on_device(v) for k, v in params.items()}}, about)
    checkpoints.close()
    asked = Certify(run=tmp_path, distance=4.0, goal=(20.0, 0.0), cells=2000, examples=30)
    assert run(asked) == 1
    document = json.loads((tmp_path / "certificate.json").read_text())
    assert document["proven"] + document["refuted"] + document["undecided"] + document["unavoidable"] == pytest.approx(
        1
    )
    assert document["barrier"]["reach"] == 8
    found = unpacked(tmp_path / "counter-examples.npz")
    assert len(found) == document["counter_examples"] > 0
    slack = encounters(found, SceneSpec())
    action = executed(found.own[:, 2:], actions(params, scales(), found), MOTION)
    assert (Barrier(kinematics=MOTION).slack(slack, action)[:, 0] < 0).all()
    told = capsys.readouterr().out
    assert "unavoidable" in told
    assert "less outward than it has to" in told


def test_the_worst_is_kept_and_what_is_not_kept_counts_too():
    few, many = (_found(most) for most in (0, 3))
    assert (len(few), few.worst) == (len(many), many.worst) == (40, -7.0)
    assert len(few.taken(1)[1]) == 0
    points, slack = many.taken(1)
    assert len(slack) == 3
    assert (slack[0], points[0, 0]) == (-7.0, 13.0)


def _found(most: int) -> _Found:
    """40 states that violate by 1, but for number 13, by 7; and one that does not."""
    found = _Found(most)
    slack = np.full(41, -1.0)
    slack[13], slack[40] = -7.0, 0.5
    found.add(np.arange(41.0)[:, None], slack)
    return found


def _on_device(tree):
    return {k: _on_device(v) for k, v in tree.items()} if isinstance(tree, dict) else jnp.asarray(tree)


@pytest.mark.parametrize(
    ("field", "value"),
    [("distance", 0.0), ("share", 0.0), ("margin", -1.0), ("time_limit", -1.0), ("finest", 0), ("goal_half", -1.0)],
)
def test_a_setting_out_of_range_is_named(field: str, value: float):
    with pytest.raises(SpecError, match=field):
        Certify(run=Path("runs/x"), **{field: value})
