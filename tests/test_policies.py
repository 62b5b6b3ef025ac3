"""What `--policy` can name, and what is said when it cannot be found or does not work."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import make_trajectories, scene_state

from envs.config import make_world
from envs.experts.config import BoidsConfig
from envs.experts.registry import make_expert
from envs.state import State
from envs.storage import save
from envs.swarm_env import scene_keys
from repair.config import ConstraintConfig
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec
from swarmnet.policies import PolicyError, Source, checked, find_policy, with_shield, with_sight

WORLD = make_world("clear", num_agents=3)
KEYS = scene_keys(0, range(2))
MODULE = """
import jax.numpy as jnp
import numpy as np
NUMBER = 3
def brake(state, params, key):
    return -state.velocity
def numpy_brake(state, params, key):
    assert isinstance(state.velocity, np.ndarray) and params is None and key.shape == (len(state.velocity), 2)
    return np.array([[-v for v in scene] for scene in np.asarray(state.velocity)])
def make_brake():
    return brake
def broken_factory():
    raise OSError("no such table")
def fails(state, params, key):
    raise KeyError("colour")
def flat(state, params, key):
    return state.velocity.reshape(len(state.velocity), -1)
def whole(state, params, key):
    return jnp.zeros(state.velocity.shape, jnp.int32)
def nan(state, params, key):
    return state.velocity.at[1, 2].set(jnp.nan) if hasattr(state.velocity, "at") else state.velocity
def branches(state, params, key):
    return state.velocity if jnp.sum(state.velocity) > 0 else jnp.zeros_like(state.velocity)
def numpy_nan(state, params, key):
    out = np.array(state.velocity)
    out[1, 2, 0] = np.inf
    return out
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with modules of users."""
    (tmp_path / "mine.py").write_text(MODULE)
    (tmp_path / "asks.py").write_text("import not_installed_anywhere\n")
    (tmp_path / "wrong.py").write_text("def f(:\n")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in ("mine", "asks", "wrong"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def state() -> State:
    rng = np.random.default_rng(0)
    spec = SceneSpec(num_agents=3)
    position, velocity = rng.uniform(-50, 50, (2, 3, 2)), rng.uniform(-5, 5, (2, 3, 2))
    return scene_state(
        spec, position, velocity, obstacle=np.full((2, 1, 2), 70.0), obstacle_present=np.ones((2, 1), bool)
    )


def policy_of(given: str):
    return find_policy(given).policy(WORLD)[0]


def test_experts_by_name_are_the_worlds_own_where_it_has_one(state: State):
    own = make_expert(WORLD.expert)(state, None, KEYS)
    for given in ("expert", "boids"):
        np.testing.assert_array_equal(policy_of(given)(state, None, KEYS), own)
    assert not np.allclose(make_expert(BoidsConfig())(state, None, KEYS), own), (
        "its own parameters differ from defaults"
    )
    vicsek = policy_of("vicsek")(state, None, KEYS)
    assert np.isfinite(vicsek).all()
    assert not np.allclose(vicsek, own)


def test_a_python_function_of_the_working_folder(state: State, here: Path):
    before = list(sys.path)
    for given in ("mine:brake", "mine:make_brake()"):
        source = find_policy(given)
        assert (source.name, source.acts, source.model, source.recording) == (given, True, None, None)
        policy, params = source.policy(WORLD)
        assert params is None
        np.testing.assert_array_equal(checked(given, policy, params, state, KEYS)(state, params, KEYS), -state.velocity)
    assert sys.path == before


def test_a_function_of_an_installed_module():
    assert policy_of("jax.numpy:zeros_like") is jnp.zeros_like


def test_a_numpy_function_works_inside_jit(state: State):
    policy = checked("mine:numpy_brake", policy_of("mine:numpy_brake"), None, state, KEYS)
    np.testing.assert_array_equal(jax.jit(lambda s, k: policy(s, None, k))(state, KEYS), -state.velocity)


def test_recordings_and_what_they_cannot(here: Path):
    save("some.h5", make_trajectories())
    source = find_policy("some.h5")
    assert (source.name, source.acts) == ("some", False)
    assert source.recording is not None
    assert len(source.recording) == 2
    with pytest.raises(PolicyError, match="recorded trajectories cannot steer"):
        source.policy(WORLD)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("nobody", "'nobody': not found; it can be expert .*boids, helbing.*module:function"),
        ("no_such:f", "there is no module 'no_such' in .* or among what is installed"),
        ("mine:fly", r"mine has no 'fly'; it has brake, numpy_brake, make_brake"),
        ("mine:NUMBER", "is of type int, not a function"),
        ("mine:broken_factory()", r"the call failed \(OSError: no such table\)"),
        ("asks:f", "there is no module 'not_installed_anywhere'$"),
        ("wrong:f", r"wrong cannot be imported \(SyntaxError"),
    ],
)
def test_what_cannot_be_found_is_named(given: str, said: str):
    with pytest.raises(PolicyError, match=said):
        find_policy(given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("mine:fails", r"failed on 2 starting states of 3 agents \(KeyError: 'colour'\)"),
        ("mine:flat", r"returned shape \(2, 6\) .* allowed is \(2, 3, 2\)"),
        ("mine:whole", "returned int32, allowed are floating-point"),
        ("mine:nan", r"returned \[nan, nan\] for agent 2 of scene 1 at the start \(1 of 2 scenes"),
        ("mine:branches", r"failed on 2 starting states of 3 agents \(TracerBoolConversionError"),
        ("mine:numpy_nan", r"for agent 2 of scene 1 at the start"),
    ],
)
def test_what_does_not_work_is_said_before_anything_runs(given: str, said: str, state: State):
    moving = jax.tree.map(jnp.asarray, state)
    with pytest.raises(PolicyError, match=said):
        checked(given, policy_of(given), None, moving, KEYS)


def test_an_empty_run_folder_is_refused(here: Path):
    from swarm_mjcf.errors import SwarmError

    (here / "run").mkdir()
    with pytest.raises(SwarmError, match="run/checkpoints: no such checkpoint folder"):
        find_policy("run")


def test_a_source_says_whether_it_acts():
    assert find_policy("expert").acts
    assert not Source(given="x.h5", name="x", recording=make_trajectories()).acts


def test_only_a_trained_model_can_see_less():
    with pytest.raises(SpecError, match="nearest: 3 was given, allowed is nothing beside expert"):
        with_sight(find_policy("expert"), nearest=3)


def test_a_filter_lets_through_what_is_allowed_and_brakes_the_rest():
    spec, source = WORLD.scene, find_policy("mine:brake")
    shielded = with_shield(source, ConstraintConfig())
    assert (shielded.name, shielded.given) == ("mine:brake, filtered", "mine:brake")
    assert with_shield(source, None) is source
    # One agent 3 m before the obstacle, one far away, both at 5 m/s towards it; a policy that only speeds up.
    reach = spec.agent_radius + spec.obstacle_radius
    position = np.array([[[-reach - 3.0, 0.0], [200.0, 0.0], [0.0, 300.0]]])
    velocity = np.array([[[5.0, 0.0], [-5.0, 0.0], [0.0, 0.0]]])
    state = scene_state(spec, position, velocity, obstacle=np.zeros((1, 1, 2)), obstacle_present=np.ones((1, 1), bool))
    moving = jax.tree.map(jnp.asarray, state)
    faster = Source(given="faster", name="faster", make=lambda world: lambda state, params, key: 0.5 * state.velocity)
    policy, params = with_shield(faster, ConstraintConfig(margin=0.5)).policy(WORLD)
    bare, action = 0.5 * velocity, np.asarray(policy(moving, params, KEYS[:1]))
    np.testing.assert_allclose(action[0, 1:], bare[0, 1:], atol=1e-5)
    # After the step it can just still brake, with 70% of the limit, before it comes to half a metre.
    dt, substeps, braking = spec.dt, spec.substeps, action[0, 0, 0]
    speed = 5.0 + dt * braking
    left = 2.5 - 5.0 * dt - dt**2 * (substeps + 1) / (2 * substeps) * braking
    assert braking < 0
    assert speed**2 == pytest.approx(2 * 0.7 * spec.max_acceleration * left, rel=1e-3)


def test_only_what_acts_can_be_filtered(here: Path):
    save("some.h5", make_trajectories())
    with pytest.raises(SpecError, match=r"filter: 'disc' was given, allowed is nothing beside some\.h5"):
        with_shield(find_policy("some.h5"), ConstraintConfig(name="disc"))
