"""Fast crashes are never missed and never deep; the presets touch as little, and as much, as they say."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import scene_state

from envs.config import make_world
from envs.engines import make_engine
from envs.experts.registry import make_expert
from envs.rollout import make_rollout
from envs.swarm_env import SwarmEnv, scene_keys
from swarm_mjcf.spec import SceneSpec

PHASES = 1000


def head_on(spec: SceneSpec, phases: int = PHASES) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two agents at top speed toward each other, each phase another point of the control step for the first touch.

    Returns whether they ever touched, whether they ever passed each other, and the deepest penetration [m], by scene.
    """
    gap = 0.5 + 2 * spec.max_speed * spec.dt * np.arange(phases) / phases  # surfaces apart at the start
    position = np.zeros((phases, 2, 2))
    position[:, 1, 0] = 2 * spec.agent_radius + gap
    velocity = np.zeros_like(position)
    velocity[:, 0, 0], velocity[:, 1, 0] = spec.max_speed, -spec.max_speed
    step = jax.jit(make_engine(spec, "native").step)
    state, still = scene_state(spec, position, velocity), np.zeros((phases, 2, 2), np.float32)
    touched, passed, depth = np.zeros(phases, bool), np.zeros(phases, bool), np.zeros(phases)
    for _ in range(4):
        state, contacts = step(state, still)
        touched |= np.asarray(contacts.agent_events).any(axis=1)
        passed |= np.asarray(state.position[:, 0, 0] >= state.position[:, 1, 0])
        depth = np.maximum(depth, np.asarray(contacts.agent_depth).max(axis=1))
    return touched, passed, depth


def test_a_head_on_crash_at_twice_top_speed_stays_below_a_quarter_radius():
    spec = SceneSpec(num_agents=2, num_obstacles=0, agent_radius=1.0, max_speed=10.0, dt=0.3, substeps=30)
    touched, passed, depth = head_on(spec)
    assert touched.all()
    assert not passed.any()
    assert depth.max() < spec.agent_radius / 4
    assert depth.min() > 0


def test_the_fewest_substeps_allowed_miss_no_crash_either():
    """15 substeps let the bodies in 0.40 m at most; 30 let them in 0.20 m (measured here)."""
    spec = SceneSpec(num_agents=2, num_obstacles=0, agent_radius=1.0, max_speed=10.0, dt=0.3, substeps=15)
    touched, passed, depth = head_on(spec)
    assert touched.all()
    assert not passed.any()
    assert 0.25 < depth.max() < 0.45


def test_the_same_crash_without_contacts_passes_through_unseen():
    spec = SceneSpec(num_agents=2, num_obstacles=0, dt=0.3, substeps=1, contacts=False)
    touched, passed, depth = head_on(spec)
    assert not touched.any()
    assert passed.all()
    assert not depth.any()


def contact_share(preset: str, *, scenes: int, num_obstacles: int = 1, **changes: object) -> float:
    """Share of control steps in which any agent of the scene touches anything."""
    world = make_world(preset, num_obstacles=num_obstacles)
    env = SwarmEnv(replace(world.scene, **changes), engine="native", spawn=world.spawn, horizon=60)
    keys = scene_keys(1, range(scenes))
    run = make_rollout(env, make_expert(world.expert), steps=60)
    contacts = jax.device_get(run(None, env.reset(keys), keys)).contacts
    return float((contacts.agent_states + contacts.obstacle_states).any(axis=2).mean())


@pytest.mark.parametrize("num_obstacles", [1, 3])
def test_the_clear_preset_touches_in_less_than_one_step_of_a_thousand(num_obstacles: int):
    assert contact_share("clear", scenes=400, num_obstacles=num_obstacles) < 1e-3


def test_the_published_rules_with_bodies_touch_much_of_the_time():
    assert 0.4 < contact_share("published", scenes=40, contacts=True, substeps=15) < 0.6
