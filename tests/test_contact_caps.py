"""Bounded room for contacts: a full cap is counted per scene and state, told to whoever reads; others lose nothing."""

import functools
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import assert_same_trajectories, scene_state, truth

from envs.engines import make_engine
from envs.engines.mjx import CAPPED_AGENTS, MjxEngine
from envs.rollout import Recording
from envs.state import Contacts, State
from envs.storage import load, save
from envs.swarm_env import SwarmEnv
from envs.trajectories import concatenate, from_recording
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

SPEC = SceneSpec(num_agents=6, num_obstacles=1, dt=0.04, substeps=2, obstacle_radius=2.0, solver_iterations=1)
CAP = 4
FAR = [[-40.0, 40.0], [-20, 40], [0, 40], [20, 40], [40, 40], [60, 40]]


def scenes() -> State:
    """Scene 0: a clump, all 15 pairs touch. 1: no pair. 2: three. 3: four, as many as the cap. 4: four, which part."""
    position = np.tile(np.array(FAR), (5, 1, 1))
    velocity = np.zeros((5, 6, 2))
    position[0] = [[0.1 * i, 0.05 * i * i] for i in range(6)]
    position[2, 1::2] = position[2, ::2] + [1.9, 0]
    position[3, :4] = [[0, 0], [1.9, 0], [1.9, 1.9], [0, 1.9]]  # a square: four sides touch, its diagonals do not
    position[4] = position[3]
    velocity[4, :4] = [[-5, -5], [5, -5], [5, 5], [-5, 5]]
    return scene_state(SPEC, position, velocity, obstacle=np.full((5, 1, 2), -30.0))


@functools.cache
def stepped(engine: str) -> tuple[State, Contacts]:
    caps = {"points": {"max_contact_points": CAP}, "pairs": {"max_contact_points": None, "max_geom_pairs": CAP}}
    physics = MjxEngine(SPEC, **caps[engine]) if engine in caps else make_engine(SPEC, engine)
    return jax.device_get(jax.jit(physics.step)(jax.device_put(scenes()), np.zeros((5, 6, 2), np.float32)))


@pytest.mark.parametrize("cap", ["points", "pairs"])
def test_states_at_which_the_cap_is_full_are_counted_in_their_scene_alone(cap: str):
    after, contacts = stepped(cap)
    # Scene 4 flies apart at 0.2 m per state and axis: from 1.9 m to 2.3 m, so nothing touches at state 1.
    assert contacts.saturated.tolist() == [2, 0, 0, int(contacts.saturated[3]), 0]
    assert contacts.saturated[3] >= 1  # exactly full: nothing was lost, but nobody can know
    expected = truth(SPEC, after)
    assert expected.agent[0].all()
    assert contacts.agent_states[0].sum() < 2 * 6  # contacts are lost in the clump, and that is what was counted
    for scene in (1, 2, 3, 4):
        np.testing.assert_array_equal(after.touching_agent[scene], expected.agent[scene])


def test_the_native_engine_has_no_cap_and_loses_nothing():
    after, contacts = stepped("native")
    assert not contacts.saturated.any()
    assert (contacts.agent_states[0] == 2).all()
    np.testing.assert_array_equal(after.touching_agent, truth(SPEC, after).agent)


@pytest.mark.parametrize("cap", ["points", "pairs"])
def test_a_cap_that_is_not_full_changes_nothing(cap: str):
    (_, free), (_, capped) = stepped("native"), stepped(cap)
    for field in ("agent_states", "obstacle_states", "agent_events"):
        np.testing.assert_array_equal(getattr(capped, field)[1:], getattr(free, field)[1:], err_msg=field)
    np.testing.assert_allclose(stepped(cap)[0].position[1:], stepped("native")[0].position[1:], atol=1e-5)


def test_caps_follow_the_number_of_agents_and_can_be_switched_off():
    small = MjxEngine(SceneSpec(num_agents=CAPPED_AGENTS))
    assert (small.max_contact_points, small.max_geom_pairs) == (None, None)
    large = MjxEngine(SceneSpec(num_agents=CAPPED_AGENTS + 4))
    assert (large.max_contact_points, large.max_geom_pairs) == (80, 160)
    free = MjxEngine(large.spec, max_contact_points=None, max_geom_pairs=None)
    assert (free.max_contact_points, free.max_geom_pairs) == (None, None)


@pytest.mark.parametrize(
    ("field", "value", "walls"),
    [
        ("max_contact_points", 0, False),
        ("max_contact_points", True, False),
        ("max_geom_pairs", -1, False),
        ("max_geom_pairs", 23, True),  # six agents and four walls: 24 pairs, of which MJX would keep the wrong ones
    ],
)
def test_a_cap_that_makes_no_sense_is_refused(field: str, value: int, walls: bool):
    with pytest.raises(SpecError, match="whole number of at least") as caught:
        MjxEngine(replace(SPEC, walls=walls), **{field: value})  # pyright: ignore[reportArgumentType]
    assert (caught.value.field, caught.value.given) == (field, value)


def test_saturation_arrives_in_trajectories_and_files_and_is_never_silent(tmp_path: Path):
    start, (after, contacts) = scenes(), stepped("points")

    def two(leaf: np.ndarray) -> np.ndarray:
        return np.stack([leaf, leaf], axis=1)

    def three(first: np.ndarray, rest: np.ndarray) -> np.ndarray:
        return np.stack([first, rest, rest], axis=1)

    recording = Recording(
        start=start,
        position=three(start.position, after.position),
        velocity=three(start.velocity, after.velocity),
        contacts=jax.tree.map(two, contacts),
    )
    total = int(2 * contacts.saturated.sum())
    with pytest.warns(UserWarning, match=f"cap was full at {total} of 20 states, in 2 of 5 scenes"):
        t = from_recording(recording, SPEC, {})
    assert t.saturated[0].tolist() == [0, 2, 2]
    assert t.saturated[1].tolist() == [0, 0, 0]
    assert concatenate([t, t.take([0])]).saturated.sum() == total + 4
    save(tmp_path / "full.h5", t)
    assert_same_trajectories(load(tmp_path / "full.h5"), t)


def test_the_environment_passes_saturation_on():
    class Full:
        """A native engine that says that its cap was full."""

        name, spec = "full", SPEC

        def __init__(self) -> None:
            self._engine = make_engine(SPEC, "native")

        def step(self, state, acceleration):
            state, contacts = self._engine.step(state, acceleration)
            return state, replace(contacts, saturated=contacts.saturated + 2)

    wanted = np.zeros((5, 6, 2), np.float32)
    wanted[1] = np.nan
    transition = jax.device_get(SwarmEnv(SPEC, engine=Full()).step(scenes(), wanted))
    assert transition.contacts.saturated.tolist() == [2, 0, 2, 2, 2]


def test_native_physics_that_runs_out_of_memory_for_contacts_raises(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into MUJOCO_LOG.TXT where it runs
    spec = SceneSpec(num_agents=100, num_obstacles=0, dt=0.02, substeps=1)
    rng = np.random.default_rng(0)
    clump = scene_state(spec, rng.uniform(-0.5, 0.5, (2, 100, 2)))  # 4950 contacts; there is room for six per agent
    engine = make_engine(spec, "native")
    with pytest.raises(Exception, match=r"EngineError: native: .*(CONTACTFULL|out of memory)"):
        jax.block_until_ready(jax.jit(engine.step)(clump, np.zeros((2, 100, 2), np.float32)))
    apart = scene_state(spec, 10.0 * np.stack(np.divmod(np.arange(100), 10), axis=-1)[None].repeat(2, 0) - 45)
    after, _ = jax.jit(engine.step)(apart, np.zeros((2, 100, 2), np.float32))  # the engine lives on
    np.testing.assert_array_equal(after.position, apart.position)
