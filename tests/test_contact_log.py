"""The contact log against momentum, against the engine's counts, against geometry, and through its files."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import scene_state

from envs.config import SpawnConfig
from envs.contact_forces import ContactForceError, physics_touches
from envs.contact_log import COLUMNS, ContactLog, ContactLogError, ContactLogWriter, contact_log, load_log, save_log
from envs.replay import touching_pairs
from envs.rollout import Recording, make_rollout
from envs.swarm_env import SwarmEnv, scene_keys
from envs.touching import BY_AGENT, BY_OBSTACLE, BY_WALL, Touches
from envs.trajectories import from_recording
from swarm_mjcf.spec import SceneSpec

MASS = 2.5
CRASH = SceneSpec(num_agents=2, num_obstacles=1, obstacle_radius=3.0, arena=20.0, walls=True, agent_mass=MASS, dt=0.1,
                  substeps=10)  # fmt: skip
STEPS = 12
PAIRS = ("agent", "kind", "partner")


def coast(state, params, key):
    """Nobody accelerates."""
    return jnp.zeros_like(state.position)


def jostle(state, params, key):
    """To the middle, with noise from each scene's key."""
    noise = jax.vmap(lambda k: jax.random.normal(k, state.position.shape[1:]))(key)
    return params * noise - 2 * state.position


def rolled(spec: SceneSpec, policy, params, start, *, steps: int = STEPS) -> tuple[SwarmEnv, Recording, jax.Array]:
    env = SwarmEnv(spec, engine="native", spawn=SpawnConfig(agent_range=3.0, overlap=True), horizon=steps)
    keys = scene_keys(3, range(len(start.position)))
    return env, jax.device_get(make_rollout(env, policy, steps=steps)(params, start, keys)), keys


@pytest.fixture(scope="module")
def crashes() -> tuple[Recording, Touches]:
    """Scene 0: head on at 8 and 4 m/s. 1: into an obstacle that stands. 2: into the south wall. 3: nobody touches."""
    away = (15.0, 15)
    start = scene_state(
        CRASH,
        [[(-3, 0), (3, 0)], [(-9, 0), away], [(0, -16), away], [(0, 0), away]],
        [[(8, 0), (-4, 0)], [(6, 0), (0, 0)], [(0, -5), (0, 0)], [(1, 0), (0, 0)]],
        obstacle=[[(-14, -14)], [(0, 0)], [(-14, -14)], [(-14, -14)]],
        obstacle_present=np.ones((4, 1), bool),
    )
    env, recording, keys = rolled(CRASH, coast, None, start)
    return recording, physics_touches(env, coast, None, recording, keys)


def momentum(recording: Recording, scene: int, agent: int) -> np.ndarray:
    velocity = np.asarray(recording.velocity)[scene, :, agent]
    return MASS * (velocity[-1] - velocity[0])


def test_the_impulse_of_a_crash_is_the_change_of_momentum(crashes):
    recording, touches = crashes
    log = contact_log(touches, CRASH.timestep)
    np.testing.assert_array_equal(log.scene, [0, 1, 2])
    assert list(log.partner_kind) == ["agent", "obstacle", "wall"]
    np.testing.assert_array_equal([log.agent, log.partner], [[0, 0, 0], [1, 0, 3]])
    for row, direction in ((0, (-1, 0)), (1, (-1, 0)), (2, (0, 1))):
        change = momentum(recording, row, 0)
        assert np.abs(change).max() > MASS, "they must really crash"
        np.testing.assert_allclose(log.impulse[row] * np.array(direction), change, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(momentum(recording, 0, 1), -momentum(recording, 0, 0), atol=1e-4)
    # By hand: reduced mass m / 2 at 12 m/s, from a crash without any rebound to one with all of it.
    assert log.impulse[0] + 1e-3 >= MASS / 2 * 12
    assert log.impulse[0] <= MASS * 12


def test_onset_speeds_and_times_of_a_crash_by_hand(crashes):
    _, touches = crashes
    log = contact_log(touches, CRASH.timestep)
    np.testing.assert_allclose(log.relative_speed, [12, 6, 5], rtol=1e-5)
    np.testing.assert_allclose(log.closing_speed, [12, 6, 5], rtol=1e-5)
    # Surfaces are 4, 5 and 3 m apart at first; the first state inside comes within one physics step after they meet.
    meets = np.array([4 / 12, 5 / 6, 3 / 5])
    assert ((log.t_start > meets - 1e-6) & (log.t_start <= meets + CRASH.timestep + 1e-6)).all()
    np.testing.assert_allclose(log.t_end - log.t_start, (log.states - 1) * CRASH.timestep, atol=1e-9)
    assert (log.depth > 0).all()
    assert (log.depth < 0.5).all()


BRAWL = SceneSpec(num_agents=5, num_obstacles=2, obstacle_radius=2.0, arena=8.0, walls=True, dt=0.06, substeps=4,
                  moving_obstacles=True)  # fmt: skip
SCENES = 16


@pytest.fixture(scope="module")
def brawl() -> tuple[SwarmEnv, Recording, jax.Array, Touches]:
    """Crowded scenes among moving obstacles, with absent bodies, in which everything touches everything."""
    rng = np.random.default_rng(2)
    start = scene_state(
        BRAWL,
        rng.uniform(-6.5, 6.5, (SCENES, 5, 2)),
        rng.uniform(-8, 8, (SCENES, 5, 2)),
        obstacle=rng.uniform(-6, 6, (SCENES, 2, 2)),
        agent_present=rng.random((SCENES, 5)) < 0.8,
        obstacle_present=rng.random((SCENES, 2)) < 0.7,
    )
    start = replace(start, obstacle_velocity=rng.uniform(-3, 3, (SCENES, 2, 2)).astype(np.float32))
    env, recording, keys = rolled(BRAWL, jostle, np.float32(20), start)
    return env, recording, keys, physics_touches(env, jostle, np.float32(20), recording, keys)


def test_states_depths_and_onsets_are_the_engines(brawl):
    _, recording, _, touches = brawl
    contacts, k = recording.contacts, BRAWL.substeps
    assert set(touches.kind) == {BY_AGENT, BY_OBSTACLE, BY_WALL}
    both = replace(touches, agent=touches.partner).take(touches.kind == BY_AGENT)
    for name, kind, parts in (
        ("agent", BY_AGENT, [touches, both]), ("obstacle", BY_OBSTACLE, [touches]), ("wall", BY_WALL, [touches])
    ):  # fmt: skip
        hits = Touches.concatenate([part.take(part.kind == kind) for part in parts])
        states = np.zeros((SCENES, STEPS, k, 5), bool)
        depth = np.zeros((SCENES, STEPS, 5))
        step, substep = np.divmod(hits.state - 1, k)
        states[hits.scene, step, substep, hits.agent] = True
        np.maximum.at(depth, (hits.scene, step, hits.agent), hits.depth)
        np.testing.assert_array_equal(states.sum(axis=2), getattr(contacts, f"{name}_states"), err_msg=name)
        np.testing.assert_allclose(depth, getattr(contacts, f"{name}_depth"), atol=1e-5, err_msg=name)
    episodes = contact_log(touches, BRAWL.timestep)
    onsets = np.asarray(contacts.obstacle_events).sum()
    assert (episodes.partner_kind == "obstacle").sum() == onsets > 0


def test_impulses_are_there_and_never_pull(brawl):
    *_, touches = brawl
    assert np.isfinite(touches.impulse).all()
    assert (touches.impulse >= 0).all()
    last = touches.state == STEPS * BRAWL.substeps
    assert last.any()
    assert (touches.impulse[last] == 0).all(), "no step begins at the last state"
    assert (touches.impulse[~last] > 0).mean() > 0.2, "bodies that part too fast are not pushed"


def test_partners_and_speeds_are_those_of_geometry(brawl):
    """At the states that were recorded, the rows, the table is that of `touching_pairs`."""
    _, recording, _, touches = brawl
    seen, _ = touching_pairs(from_recording(recording, BRAWL, {}), states=1, arena=BRAWL.arena)
    rows = touches.take(touches.state % BRAWL.substeps == 0)
    rows, seen = (table.take(table.depth > 1e-3) for table in (rows, seen))  # clear of the borderline
    assert len(seen) > 30
    np.testing.assert_array_equal(rows.state // BRAWL.substeps, seen.state)
    for name in ("scene", *PAIRS):
        np.testing.assert_array_equal(getattr(rows, name), getattr(seen, name), err_msg=name)
    for name in ("depth", "relative_speed", "closing_speed"):
        np.testing.assert_allclose(getattr(rows, name), getattr(seen, name), atol=1e-4, err_msg=name)


def test_another_policy_than_the_recorded_one_is_noticed(brawl):
    env, recording, keys, _ = brawl
    with pytest.raises(ContactForceError, match=r"control step \d+ of scene \d+, run again, ends"):
        physics_touches(env, coast, None, recording, keys)


def touches_of(*entries: tuple) -> Touches:
    """From (scene, state, agent, kind, partner, depth) entries; closing speeds count up, impulses are 1."""
    columns = np.array(entries, float).reshape(-1, 6).T
    names = ("scene", "state", "agent", "kind", "partner")
    count = len(entries)
    return Touches(
        **{name: columns[i].astype(int) for i, name in enumerate(names)},
        depth=columns[5],
        relative_speed=np.arange(count, dtype=float),
        closing_speed=-np.arange(count, dtype=float),
        impulse=np.ones(count),
    )


def test_episodes_by_hand():
    """Agents 0 and 1 meet twice, agent 1 leans on an obstacle across two control steps; the order does not matter."""
    log = contact_log(
        touches_of(
            (0, 4, 0, BY_AGENT, 1, 0.1), (0, 9, 0, BY_AGENT, 1, 0.4), (0, 6, 1, BY_OBSTACLE, 0, 0.2),
            (0, 7, 1, BY_OBSTACLE, 0, 0.5), (0, 8, 1, BY_OBSTACLE, 0, 0.3), (0, 5, 0, BY_AGENT, 1, 0.3),
            (1, 6, 0, BY_AGENT, 1, 0.7),
        ),
        0.01,
        first_scene=10,
    )  # fmt: skip
    np.testing.assert_array_equal(log.scene, [10, 10, 10, 11])
    assert list(log.partner_kind) == ["agent", "obstacle", "agent", "agent"]
    np.testing.assert_array_equal(log.t_start, [0.04, 0.06, 0.09, 0.06])
    np.testing.assert_array_equal(log.t_end, [0.05, 0.08, 0.09, 0.06])
    np.testing.assert_array_equal(log.states, [2, 3, 1, 1])
    np.testing.assert_array_equal(log.depth, [0.3, 0.5, 0.4, 0.7])
    np.testing.assert_array_equal(log.relative_speed, [0, 2, 1, 6])  # of the first state of each
    np.testing.assert_array_equal(log.impulse, [2, 3, 1, 1])


def assert_same_log(one: ContactLog, other: ContactLog) -> None:
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_files_hold_the_log_to_the_bit(tmp_path, ending: str, crashes, brawl):
    whole = [contact_log(crashes[1], CRASH.timestep), contact_log(brawl[3], BRAWL.timestep, first_scene=4)]
    path = tmp_path / "deep" / f"contacts{ending}"
    with ContactLogWriter(path) as writer:
        for part in whole:
            writer.append(part)
    again = load_log(path)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(again, name), np.concatenate([getattr(p, name) for p in whole]))
    empty = contact_log(touches_of(), 0.1)
    save_log(path, empty)
    assert_same_log(load_log(path), empty)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_csv_is_what_people_expect(tmp_path):
    touches = replace(touches_of((0, 3, 0, BY_AGENT, 1, 0.25)), impulse=np.array([np.nan]))
    save_log(tmp_path / "c.csv", contact_log(touches, 0.1))
    header, row = (tmp_path / "c.csv").read_text().splitlines()
    assert header.replace('"', "") == ",".join(COLUMNS)
    assert row.replace('"', "") == "0,0,agent,1,0.3,0.3,1,0.25,0,-0,"
    assert np.isnan(load_log(tmp_path / "c.csv").impulse).all()


def test_what_cannot_be_written_or_read_is_named(tmp_path):
    log = contact_log(touches_of(), 0.1)
    with pytest.raises(ContactLogError, match=r"ends in \.csv or \.parquet, not in '\.txt'"):
        save_log(tmp_path / "c.txt", log)
    with pytest.raises(ContactLogError, match="cannot be written"):
        save_log("/proc/nowhere/c.csv", log)
    for name, content in (("none.csv", None), ("bad.parquet", b"PAR?"), ("bad.csv", b"a,b\n1,2\n")):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ContactLogError, match=f"{name}: no contact log that can be read"):
            load_log(tmp_path / name)


def test_an_error_on_the_way_leaves_the_old_file(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("old")

    def fail() -> None:
        with ContactLogWriter(path) as writer:
            writer.append(contact_log(touches_of(), 0.1))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
