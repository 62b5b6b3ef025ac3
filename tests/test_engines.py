"""Physics against geometry and closed forms, and each engine against the other. The module shares MJX compiles."""

import collections
import functools
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Truth, assert_same, scene_state, scenes_of, truth

from envs.dynamics import free_flight, limited
from envs.engines import make_engine
from envs.state import Contacts, State
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

ENGINES = ("native", "mjx")
SINGLE = SceneSpec(num_agents=4, num_obstacles=2, obstacle_radius=2.5, arena=12.0, walls=True, dt=0.02, substeps=1)
"""One physics step: the returned state is the one whose contacts are told."""
FLOCK = SceneSpec(num_agents=3, num_obstacles=1, obstacle_radius=3.0, substeps=15)
FLOCK_SCENES = 128
FLY_BY = SceneSpec(num_agents=2, num_obstacles=1, arena=20.0, walls=True, dt=0.1, substeps=5)


TRACES: collections.Counter = collections.Counter()
"""How often each step was traced, and so compiled, for each number of scenes."""


@functools.cache
def stepper(spec: SceneSpec, engine: str, threads: int):
    """The compiled step of an engine, made once per module: MJX takes some ten seconds."""
    physics = make_engine(spec, engine, threads=threads)

    def traced(state: State, acceleration):
        TRACES[spec, engine, threads, len(state.position)] += 1
        return physics.step(state, acceleration)

    return jax.jit(traced)


def step(spec: SceneSpec, engine: str, state: State, acceleration=None, threads: int = 0) -> tuple[State, Contacts]:
    still = np.zeros(state.position.shape, np.float32)
    acceleration = still if acceleration is None else np.asarray(acceleration, np.float32)
    return jax.device_get(stepper(spec, engine, threads)(*jax.device_put((state, acceleration))))


def dense(seed: int = 0, scenes: int = 256) -> State:
    """Crowded scenes: about every second agent touches something; walls included."""
    rng = np.random.default_rng(seed)
    agents = rng.uniform(-11.8, 11.8, (scenes, SINGLE.num_agents, 2))
    near = rng.uniform(-2.5, 2.5, (scenes, 2, 2))
    agents[:, 1:3] = np.clip(agents[:, :1] + near, -11.8, 11.8)
    velocity = rng.uniform(-7, 7, agents.shape)
    return scene_state(SINGLE, agents, velocity, obstacle=rng.uniform(-9, 9, (scenes, SINGLE.num_obstacles, 2)))


@functools.cache
def single_step(engine: str) -> tuple[State, Contacts, Truth]:
    after, contacts = step(SINGLE, engine, dense(), np.random.default_rng(5).uniform(-7, 7, (256, 4, 2)))
    return after, contacts, truth(SINGLE, after)


@pytest.mark.parametrize("engine", ENGINES)
def test_no_contact_flag_is_wrong_against_float64_geometry(engine: str):
    after, _, expected = single_step(engine)
    clear = ~expected.borderline
    assert clear.mean() > 0.99
    touching = expected.agent | expected.obstacle.any(-1) | expected.wall
    assert touching.mean() > 0.2
    for kind in (expected.agent, expected.obstacle, expected.wall):
        assert 0.02 < kind.mean() < 0.98  # each kind is tested both ways
    np.testing.assert_array_equal(after.touching_agent[clear], expected.agent[clear])
    np.testing.assert_array_equal(after.touching_obstacle[clear], expected.obstacle[clear])
    np.testing.assert_array_equal(after.touching_wall[clear], expected.wall[clear])


@pytest.mark.parametrize("engine", ENGINES)
def test_counts_of_a_single_state_are_its_flags_and_kinds_are_told_apart(engine: str):
    after, contacts, expected = single_step(engine)
    both = expected.agent & expected.obstacle.any(-1) & ~expected.borderline
    assert both.sum() >= 5  # told apart even where an agent touches both kinds at once
    assert (contacts.agent_states[both] == 1).all()
    assert (contacts.obstacle_states[both] == 1).all()
    np.testing.assert_array_equal(contacts.agent_states, after.touching_agent)
    np.testing.assert_array_equal(contacts.obstacle_states, after.touching_obstacle.any(-1))
    np.testing.assert_array_equal(contacts.wall_states, after.touching_wall)
    # State 0 was said to touch nothing, so each touch is an onset, and each obstacle counts for itself.
    np.testing.assert_array_equal(contacts.agent_events, after.touching_agent)
    np.testing.assert_array_equal(contacts.obstacle_events, after.touching_obstacle.sum(-1))
    np.testing.assert_array_equal(contacts.wall_events, after.touching_wall)


@pytest.mark.parametrize("engine", ENGINES)
def test_depths_are_those_of_geometry(engine: str):
    _, contacts, expected = single_step(engine)
    clear = ~expected.borderline
    assert expected.agent_depth.max() > 0.5
    for name in ("agent_depth", "obstacle_depth", "wall_depth"):
        depth = getattr(contacts, name)
        np.testing.assert_allclose(depth[clear], getattr(expected, name)[clear], atol=2e-5, err_msg=name)
        assert (depth >= 0).all()


def test_both_engines_agree_on_every_flag_and_body_of_a_single_step():
    (native, here, expected), (mjx, there, _) = single_step("native"), single_step("mjx")
    for name in ("touching_agent", "touching_obstacle", "touching_wall"):
        clear = ~expected.borderline
        np.testing.assert_array_equal(getattr(native, name)[clear], getattr(mjx, name)[clear], err_msg=name)
    np.testing.assert_allclose(native.position, mjx.position, atol=1e-4)
    for name in ("agent_depth", "obstacle_depth", "wall_depth"):
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), atol=2e-4, err_msg=name)


@pytest.mark.parametrize("k", [1, 2, 30])
@pytest.mark.parametrize("engine", ENGINES)
def test_free_flight_is_the_closed_form(engine: str, k: int):
    spec = SceneSpec(num_agents=2, num_obstacles=0, substeps=k, contacts=False)
    rng = np.random.default_rng(k)
    position, velocity, u = (rng.uniform(-h, h, (64, 2, 2)).astype(np.float32) for h in (90, 10, 10))
    after, contacts = step(spec, engine, scene_state(spec, position, velocity), u)
    x, v, a = (array.astype(np.float64) for array in (position, velocity, u))
    expected = x + v * 0.3 + a * 0.3**2 * (k + 1) / (2 * k)
    np.testing.assert_allclose(after.position, expected, rtol=0, atol=1e-5 * spec.arena)
    np.testing.assert_allclose(after.velocity, v + a * 0.3, rtol=0, atol=1e-5 * spec.arena)
    assert not any(np.asarray(field).any() for field in jax.tree.leaves(contacts))
    # The decoder's formula in float32 is the same law.
    decoded, decoded_velocity = free_flight(jnp.asarray(position), jnp.asarray(velocity), jnp.asarray(u), spec)
    np.testing.assert_allclose(decoded, after.position, rtol=0, atol=1e-5 * spec.arena)
    np.testing.assert_allclose(decoded_velocity, after.velocity, rtol=0, atol=1e-5 * spec.arena)


@pytest.mark.parametrize("engine", ENGINES)
def test_free_flight_holds_with_contacts_switched_on(engine: str):
    rng = np.random.default_rng(3)
    agents = np.array([[-30.0, 0], [0, 30], [30, 0]]) + rng.uniform(-3, 3, (FLOCK_SCENES, 3, 2))
    velocity, u = (rng.uniform(-5, 5, agents.shape).astype(np.float32) for _ in range(2))
    start = scene_state(FLOCK, agents, velocity, obstacle=np.zeros((FLOCK_SCENES, 1, 2)))
    after, contacts = step(FLOCK, engine, start, u)
    assert not contacts.agent_states.any()
    expected = start.position.astype(np.float64) + velocity * 0.3 + u * 0.09 * 16 / 30
    np.testing.assert_allclose(after.position, expected, rtol=0, atol=1e-5 * FLOCK.arena)
    np.testing.assert_array_equal(after.obstacle, start.obstacle)
    np.testing.assert_array_equal(after.step, start.step)  # steps are the environment's to count


def run(engine: str, state: State, accelerations: np.ndarray) -> tuple[list[State], list[Contacts]]:
    states, contacts = [], []
    for wanted in accelerations:
        executed = limited(jnp.asarray(state.velocity), jnp.asarray(wanted), FLOCK)
        state, touched = step(FLOCK, engine, state, executed)
        states.append(state)
        contacts.append(touched)
    return states, contacts


def test_engines_agree_over_twenty_steps_without_contact():
    rng = np.random.default_rng(7)
    agents = np.array([[-30.0, 0], [0, 30], [30, 0]]) + rng.uniform(-3, 3, (FLOCK_SCENES, 3, 2))
    start = scene_state(FLOCK, agents, rng.uniform(-0.3, 0.3, agents.shape), obstacle=np.zeros((FLOCK_SCENES, 1, 2)))
    accelerations = rng.uniform(-1, 1, (20, *agents.shape)).astype(np.float32)
    ends = {}
    for engine in ENGINES:
        states, contacts = run(engine, start, accelerations)
        assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(contacts))
        ends[engine] = states
    for native, mjx in zip(*ends.values(), strict=True):
        np.testing.assert_allclose(native.position, mjx.position, rtol=0, atol=1e-4)
        np.testing.assert_allclose(native.velocity, mjx.velocity, rtol=0, atol=1e-4)
    assert np.abs(ends["mjx"][-1].position - start.position).max() > 3


def test_engines_agree_in_99_percent_of_scenes_with_collisions_after_ten_steps():
    rng = np.random.default_rng(11)
    agents = np.array([[-12.0, 0], [12, 0], [0, 10]]) + rng.uniform(-1.5, 1.5, (FLOCK_SCENES, 3, 2))
    toward = -agents / np.linalg.norm(agents, axis=-1, keepdims=True)
    obstacle = rng.uniform(-3, 3, (FLOCK_SCENES, 1, 2)) - [0, 8]
    start = scene_state(FLOCK, agents, 5 * toward + rng.uniform(-1, 1, agents.shape), obstacle=obstacle)
    accelerations = rng.uniform(-2, 2, (10, *agents.shape)).astype(np.float32)
    (native, here), (mjx, there) = (run(engine, start, accelerations) for engine in ENGINES)
    collided = np.any([(c.agent_states + c.obstacle_states).any(axis=1) for c in here], axis=0)
    assert collided.mean() > 0.5
    apart = np.abs(native[-1].position - mjx[-1].position).max(axis=(1, 2))
    assert (apart[collided] <= 1e-2).mean() >= 0.99
    ours, theirs = (sum(c.agent_events.sum() for c in contacts) for contacts in (here, there))
    assert abs(int(ours) - int(theirs)) <= 0.01 * ours


H, SPEED, SHALLOW = 0.02, 10.0, 5e-4
FAR = [[-15.0, 15.0], [15.0, 15.0]]


def fly_by() -> State:
    """Scenes 0..5: agent 1 passes agent 0 and touches it at state j alone; 6..11: agent 0 an obstacle; 12..17: a wall.

    A pass at 10 m/s moves 0.2 m per state: 0.0005 m deep at state j, it is out of reach at the states before and after.
    At the wall the agent brakes at 25 m/s^2 and turns back at state j, 5 mm from the states beside it.
    """
    states = np.arange(FLY_BY.substeps + 1)
    position = np.tile(np.array(FAR), (3 * len(states), 1, 1))
    velocity = np.zeros_like(position)
    obstacle = np.tile(np.array([[0.0, -12.0]]), (3 * len(states), 1, 1))
    agents, solids, walls = (slice(n * len(states), (n + 1) * len(states)) for n in range(3))
    position[agents, 0] = 0, 5
    position[agents, 1, 0] = -SPEED * H * states
    position[agents, 1, 1] = 5 + 2 - SHALLOW
    velocity[agents, 1] = SPEED, 0
    position[solids, 0, 0] = -SPEED * H * states
    position[solids, 0, 1] = -12 + 8 - SHALLOW
    velocity[solids, 0] = SPEED, 0
    speed = BRAKING * H * (states + 0.5)
    travelled = np.array([sum(H * (v - BRAKING * H * i) for i in range(1, j + 1)) for j, v in zip(states, speed)])  # noqa: B905
    position[walls, 0, 0] = FLY_BY.arena - 1 + 0.002 - travelled
    position[walls, 0, 1] = 0
    velocity[walls, 0, 0] = speed
    return scene_state(FLY_BY, position, velocity, obstacle=obstacle)


BRAKING = 25.0


@functools.cache
def flown_by(engine: str) -> tuple[State, Contacts]:
    braking = np.zeros((18, 2, 2))
    braking[12:, 0, 0] = -BRAKING
    return step(FLY_BY, engine, fly_by(), braking)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_only_contact_is_counted_once_at_each_of_the_states_1_to_k(engine: str):
    after, contacts = flown_by(engine)
    once = np.minimum(np.arange(6), 1)  # scene 0 touches at state 0, which belongs to the step before
    zero = np.zeros(6, int)
    expected = {
        "agent_states": np.stack([np.r_[once, zero, zero]] * 2, axis=1),
        "obstacle_states": np.stack([np.r_[zero, once, zero], np.zeros(18, int)], axis=1),
        "wall_states": np.stack([np.r_[zero, zero, once], np.zeros(18, int)], axis=1),
    }
    for name, count in expected.items():
        np.testing.assert_array_equal(getattr(contacts, name), count, err_msg=name)
        np.testing.assert_array_equal(getattr(contacts, name.replace("states", "events")), count, err_msg=name)
    depth = np.where(expected["agent_states"], SHALLOW, 0)
    np.testing.assert_allclose(contacts.agent_depth, depth, atol=2e-5)
    np.testing.assert_allclose(contacts.obstacle_depth, np.where(expected["obstacle_states"], SHALLOW, 0), atol=2e-5)
    np.testing.assert_allclose(contacts.wall_depth, np.where(expected["wall_states"], 0.002, 0), atol=2e-5)
    # Flags tell state k alone: the scenes with j = k = 5.
    assert np.argwhere(after.touching_agent).tolist() == [[5, 0], [5, 1]]
    assert np.argwhere(after.touching_obstacle).tolist() == [[11, 0, 0]]
    assert np.argwhere(after.touching_wall).tolist() == [[17, 0]]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_contact_that_lasts_over_a_step_boundary_is_one_event(engine: str):
    position = np.tile(np.array(FAR), (18, 1, 1))
    position[:] = [[0, 5], [1.8, 5]]
    first = scene_state(FLY_BY, position, obstacle=np.full((18, 1, 2), [0.0, -12.0]))
    pressed = np.zeros((18, 2, 2))
    pressed[:, 0, 0], pressed[:, 1, 0] = 40, -40
    second, begun = step(FLY_BY, engine, first, pressed)
    third, lasting = step(FLY_BY, engine, second, pressed)
    assert second.touching_agent.all()
    assert third.touching_agent.all()
    assert (begun.agent_states == 5).all()
    assert (begun.agent_events == 1).all()
    assert (lasting.agent_states == 5).all()
    assert (lasting.agent_events == 0).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_results_depend_neither_on_batch_size_nor_on_position_in_the_batch(engine: str):
    start = fly_by()
    whole, counted = step(FLY_BY, engine, start)
    order = np.random.default_rng(0).permutation(18)
    shuffled, recounted = step(FLY_BY, engine, scenes_of(start, order))
    few, few_counted = step(FLY_BY, engine, scenes_of(start, slice(4, 9)))
    if engine == "native":
        assert_same(shuffled, scenes_of(whole, order))
        assert_same(recounted, scenes_of(counted, order))
        assert_same(few, scenes_of(whole, slice(4, 9)))
        assert_same(few_counted, scenes_of(counted, slice(4, 9)))
        return
    np.testing.assert_allclose(shuffled.position, whole.position[order], atol=1e-5)
    np.testing.assert_allclose(few.position, whole.position[4:9], atol=1e-5)
    np.testing.assert_array_equal(recounted.agent_states, counted.agent_states[order])
    np.testing.assert_array_equal(few_counted.agent_states, counted.agent_states[4:9])


@pytest.mark.parametrize("k", [1, 10])
def test_native_results_are_the_same_bits_for_any_threads_batch_and_history(k: int):
    spec = replace(SINGLE, substeps=k)
    start, wanted = dense(seed=2), np.random.default_rng(1).uniform(-7, 7, (256, 4, 2)).astype(np.float32)
    whole = step(spec, "native", start, wanted)
    assert whole[1].agent_states.any()
    for threads in (1, 2):
        assert_same(step(spec, "native", start, wanted, threads), whole)
    one_by_one = [step(spec, "native", scenes_of(start, [i]), wanted[[i]]) for i in range(20)]
    for i, alone in enumerate(one_by_one):
        assert_same(alone, scenes_of(whole, [i]))
    step(spec, "native", dense(seed=9), -wanted)  # what a worker did before leaves no trace
    assert_same(step(spec, "native", start, wanted), whole)


def mixed_scenes() -> tuple[State, np.ndarray, np.ndarray]:
    """Crowded scenes of 1..3 agents and 0..1 obstacle."""
    rng = np.random.default_rng(4)
    agents = rng.uniform(-4, 4, (FLOCK_SCENES, 3, 2))
    present = np.arange(3) < rng.integers(1, 4, FLOCK_SCENES)[:, None]
    obstacle_present = rng.random((FLOCK_SCENES, 1)) < 0.5
    velocity = rng.uniform(-6, 6, agents.shape)
    where = {"obstacle": rng.uniform(-6, 6, (FLOCK_SCENES, 1, 2)), "obstacle_present": obstacle_present}
    return scene_state(FLOCK, agents, velocity, agent_present=present, **where), present, obstacle_present


@pytest.mark.parametrize("engine", ENGINES)
def test_absent_bodies_never_move_never_touch_and_change_nothing_for_the_others(engine: str):
    start, present, obstacle_present = mixed_scenes()
    after, contacts = start, None
    for _ in range(3):
        after, contacts = step(FLOCK, engine, after)
        for leaf in jax.tree.leaves(contacts):
            assert not leaf[~present if leaf.ndim == 2 else slice(None)].any()  # nor is any cap full
        assert not contacts.obstacle_states[~obstacle_present[:, 0]].any()
        np.testing.assert_array_equal(after.position[~present], start.position[~present])
        np.testing.assert_array_equal(after.velocity[~present], 0)
        np.testing.assert_array_equal(after.obstacle, start.obstacle)
    assert contacts is not None
    assert contacts.agent_states.any()
    # The same scenes in worlds that have no room for the absent ones.
    for agents in (1, 2, 3):
        for obstacles in (0, 1):
            rows = (present.sum(axis=1) == agents) & (obstacle_present[:, 0] == bool(obstacles))
            assert rows.sum() >= 5
            small = replace(FLOCK, num_agents=agents, num_obstacles=obstacles)
            alone = scene_state(
                small,
                start.position[rows, :agents],
                start.velocity[rows, :agents],
                obstacle=start.obstacle[rows, :obstacles],
            )
            touched = None
            for _ in range(3):
                alone, touched = step(small, "native", alone)
            difference = np.abs(alone.position - after.position[rows, :agents]).max(axis=(1, 2))
            assert (difference < (1e-5 if engine == "native" else 1e-2)).mean() >= 0.95
            if engine == "native":
                assert touched is not None
                np.testing.assert_array_equal(touched.agent_states, contacts.agent_states[rows, :agents])
                np.testing.assert_array_equal(touched.obstacle_states, contacts.obstacle_states[rows, :agents])


def test_parked_bodies_touch_no_wall():
    start = dense()
    present = np.tile([True, False, True, False], (256, 1))
    start = scene_state(SINGLE, start.position, start.velocity, agent_present=present)  # and no obstacle
    for engine in ENGINES:
        after, contacts = step(SINGLE, engine, start)
        np.testing.assert_array_equal(after.position[~present], start.position[~present])
        assert not contacts.wall_states[~present].any()
        assert not after.touching_wall[~present].any()
        assert not contacts.obstacle_states.any()
        assert contacts.wall_states[present].any()


@pytest.mark.parametrize("engine", ENGINES)
def test_a_step_compiles_once_per_shape_and_feeds_its_own_output(engine: str):
    state, still = jax.device_put((fly_by(), np.zeros((18, 2, 2), np.float32)))
    for _ in range(4):
        state, _ = stepper(FLY_BY, engine, 0)(state, still)
    assert TRACES[FLY_BY, engine, 0, 18] == 1


def test_the_native_engine_runs_inside_scan_as_outside():
    start, accelerations = fly_by(), np.random.default_rng(0).uniform(-5, 5, (4, 18, 2, 2)).astype(np.float32)
    engine = make_engine(FLY_BY, "native")
    scanned = jax.device_get(jax.jit(lambda s, a: jax.lax.scan(engine.step, s, a))(start, accelerations))
    state = start
    for t, acceleration in enumerate(accelerations):
        state, contacts = step(FLY_BY, "native", state, acceleration)
        assert_same(jax.tree.map(lambda leaf, t=t: leaf[t], scanned[1]), contacts)
    assert_same(scanned[0], state)


def test_one_engine_serves_several_threads_at_once():
    engine = make_engine(FLOCK, "native", threads=1)
    compiled = jax.jit(engine.step)
    starts = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        where = rng.uniform(-5, 5, (40, 3, 2))
        starts.append(scene_state(FLOCK, where, -where, obstacle=rng.uniform(-5, 5, (40, 1, 2))))
    still = np.zeros((40, 3, 2), np.float32)
    expected = [jax.device_get(compiled(start, still)) for start in starts]
    assert any(contacts.agent_states.any() for _, contacts in expected)
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda start: jax.device_get(compiled(start, still)), starts * 5))
    for i, result in enumerate(got):
        assert_same(result, expected[i % 8])


SHARDED = """
import os
os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=4"
import jax, numpy as np
from jax.sharding import Mesh, PartitionSpec
from envs.engines import make_engine
from envs.state import make_state
from swarm_mjcf.spec import SceneSpec

spec = SceneSpec(num_agents=3, num_obstacles=1, substeps=15)
assert len(jax.devices()) == 4
rng = np.random.default_rng(0)
array = lambda *shape: rng.uniform(-9, 9, shape).astype(np.float32)
state = make_state(position=array(32, 3, 2), velocity=array(32, 3, 2), goal=array(32, 2), obstacle=array(32, 1, 2))
acceleration = array(6, 32, 3, 2)
engine = make_engine(spec, "native", threads=1)
run = lambda state, acceleration: jax.lax.scan(engine.step, state, acceleration)
scenes, later = PartitionSpec("scene"), PartitionSpec(None, "scene")
specs = (scenes, later)
# A callback's result has no varying axes in JAX's eyes, so that check is off.
split = jax.shard_map(run, mesh=Mesh(jax.devices(), "scene"), in_specs=specs, out_specs=specs, check_vma=False)
here, there = jax.device_get((jax.jit(run)(state, acceleration), jax.jit(split)(state, acceleration)))
assert here[1].agent_states.any() and here[1].obstacle_states.any()
for a, b in zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True):
    np.testing.assert_array_equal(a, b)
print("same on", len(split and jax.devices()), "devices")
"""


def test_under_shard_map_every_device_calls_the_native_engine_and_results_are_the_same():
    root = Path(__file__).parents[1]
    result = subprocess.run([sys.executable, "-c", SHARDED], cwd=root, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert result.stdout == "same on 4 devices\n"


def test_an_unknown_engine_is_refused_with_the_known_ones():
    with pytest.raises(SpecError, match="auto, native, mjx, mjx-warp") as caught:
        make_engine(FLOCK, "bullet")
    assert (caught.value.field, caught.value.given) == ("engine", "bullet")


def test_mjx_prints_nothing_where_a_programs_output_belongs():
    root = Path(__file__).parents[1]
    result = subprocess.run(
        [sys.executable, "-c", "import envs.engines.mjx"], cwd=root, capture_output=True, text=True, timeout=300
    )
    assert (result.returncode, result.stdout) == (0, ""), result.stderr
