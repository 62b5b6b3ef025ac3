"""The optional engine: a clear error without the extra; with it, the same physics and counts as the native engine."""

import functools
import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import scene_state, truth

from envs.engines import make_engine
from envs.engines.engine import EngineError
from envs.state import Contacts, State
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

ROOT = Path(__file__).parents[1]
INSTALLED = importlib.util.find_spec("warp") is not None
SPEC = SceneSpec(
    num_agents=4,
    num_obstacles=1,
    obstacle_radius=2.0,
    arena=12.0,
    dt=0.06,
    substeps=3,
    moving_obstacles=True,
    walls=True,
)
SCENES = 48


def test_without_the_extra_one_error_names_it_and_the_device_it_is_for():
    code = """
import importlib.util, sys
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name == "warp" else find(name, *rest)
from envs.engines import make_engine
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.spec import SceneSpec
try:
    make_engine(SceneSpec(), "mjx-warp")
except SwarmError as error:
    print(error)
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert "pip install 'mujoco-mjx[warp]<4'" in result.stdout
    assert "NVIDIA" in result.stdout
    assert result.stdout.count("\n") == 1


@pytest.mark.skipif(INSTALLED, reason="the extra is installed")
def test_it_is_refused_here_by_its_name():
    with pytest.raises(EngineError, match="mjx-warp is not installed"):
        make_engine(SPEC, "mjx-warp")


def crowded() -> State:
    rng = np.random.default_rng(3)
    position = rng.uniform(-11.8, 11.8, (SCENES, 4, 2))
    position[:, 1] = np.clip(position[:, 0] + rng.uniform(-2, 2, (SCENES, 2)), -11.8, 11.8)
    state = scene_state(
        SPEC,
        position,
        rng.uniform(-6, 6, position.shape),
        obstacle=rng.uniform(-8, 8, (SCENES, 1, 2)),
        agent_present=np.arange(4) < rng.integers(2, 5, (SCENES, 1)),
        obstacle_present=rng.random((SCENES, 1)) < 0.7,
    )
    pace = rng.uniform(-7, 7, (SCENES, 1, 2)) * state.obstacle_present[..., None]
    return replace(state, obstacle_velocity=pace.astype(np.float32))


@functools.cache
def stepped(engine: str, room: int | None = None) -> tuple[State, Contacts]:
    if engine == "mjx-warp":
        pytest.importorskip("warp")
        from envs.engines.mjx_warp import MjxWarpEngine

        physics = MjxWarpEngine(SPEC, max_contact_points=room)
    else:
        physics = make_engine(SPEC, engine)
    return jax.device_get(jax.jit(physics.step)(jax.device_put(crowded()), np.zeros((SCENES, 4, 2), np.float32)))


def test_with_the_extra_it_counts_what_the_native_engine_counts():
    (there, warp), (here, native) = stepped("mjx-warp"), stepped("native")
    sure = ~truth(SPEC, here).borderline.any(axis=1)
    assert native.agent_states.sum() > 40
    assert native.obstacle_states.sum() > 10
    assert native.wall_states.sum() > 5
    for field in ("agent_states", "obstacle_states", "wall_states", "agent_events", "obstacle_events"):
        assert (getattr(warp, field)[sure] != getattr(native, field)[sure]).mean() <= 0.01, field
    for field in ("touching_agent", "touching_obstacle", "touching_wall"):
        np.testing.assert_array_equal(getattr(there, field)[sure], getattr(here, field)[sure], err_msg=field)
    np.testing.assert_allclose(there.position, here.position, atol=1e-3)
    np.testing.assert_allclose(there.obstacle, here.obstacle, atol=1e-6)
    assert not warp.saturated.any()


def test_with_the_extra_too_little_room_is_counted_where_it_was_too_little():
    _, contacts = stepped("mjx-warp", 1)
    _, native = stepped("native")
    solid = native.obstacle_states + native.wall_states
    alone = ((native.agent_states + solid) == 0).all(axis=1)
    twice = ((native.agent_states == 3) & (solid == 3)).any(axis=1)  # two contacts of one agent, and room for one
    assert alone.sum() > 2
    assert twice.sum() > 2
    assert not contacts.saturated[alone].any()
    assert (contacts.saturated[twice] > 0).all()


def test_with_the_extra_a_room_that_makes_no_sense_is_refused():
    pytest.importorskip("warp")
    from envs.engines.mjx_warp import MjxWarpEngine

    with pytest.raises(SpecError, match="at least 1"):
        MjxWarpEngine(SPEC, max_contact_points=0)


def test_with_the_extra_nothing_is_printed_where_a_programs_output_belongs():
    pytest.importorskip("warp")
    code = """
from envs.engines import make_engine
from swarm_mjcf.spec import SceneSpec
make_engine(SceneSpec(), "mjx-warp")
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert (result.returncode, result.stdout) == (0, ""), result.stderr
