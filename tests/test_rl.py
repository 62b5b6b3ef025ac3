"""PPO on a SwarmNet in physics: going on, freezing, divergence, engines; the actor-critic against its own network."""

import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning import quick_compiles, tiny
from probes import Plain, Probe, probe_actor

from envs.config import RewardConfig, SimulateConfig, make_world, mixed
from envs.swarm_env import SwarmEnv, scene_keys
from gnn.checkpoint import CheckpointError, Model, load_model
from gnn.decode import Integrator, make_policy, network_init
from gnn.features import Scales
from gnn.graph import graph_of_state
from rl.actor_critic import STD, VALUE, network_weights, swarm_actor_critic
from rl.collect import collect, start
from rl.config import PPOConfig
from rl.task import SwarmTask
from rl.train import RLError, make_learner, train
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.cli import main

CONFIG = PPOConfig(scenes=6, steps=4, iterations=4, warmup=1, epochs=1, minibatches=2, checkpoint_seconds=0.0)


@pytest.fixture(autouse=True, scope="module")
def _quickly():
    with quick_compiles():
        yield


@cache
def task(engine="plain", *, horizon=6, terminate=False):
    """Two to three agents and an obstacle in a small square, so that there are contacts and resets."""
    world = mixed(make_world("clear", num_agents=3, num_obstacles=1), min_agents=2)
    spawn = replace(world.spawn, agent_range=14.0, goal_range=5.0, clearance=1.0)
    engine = Plain(world.scene) if engine == "plain" else engine
    env = SwarmEnv(world.scene, engine=engine, spawn=spawn, horizon=horizon, terminate_on_contact=terminate)
    return SwarmTask(env, RewardConfig())


@cache
def model(preset="thesis-ch5"):
    """A network with few random weights."""
    spec, config = task().env.spec, tiny(preset)
    sizes = {"position": 10.0, "velocity": 5.0, "acceleration": 3.0, "position_change": 1.0, "velocity_change": 1.0}
    sizes = {name: jnp.asarray(value, jnp.float32) for name, value in sizes.items()}
    scales = Scales(centre=jnp.zeros(2, jnp.float32), **sizes)
    state = task().env.reset(scene_keys(0, range(2)))
    nodes, graph = graph_of_state(state, goal=True)
    params = jax.jit(network_init(config, scales))(jax.random.key(0), nodes[:, None], graph)
    integrator = Integrator(spec.dt, spec.substeps, spec.max_speed, spec.max_acceleration)
    about = {"preset": preset, "data": {"scenes": 1}, "range": {}, "train": {}}
    return Model(config, scales, integrator, jax.device_get(params), about)


def same(one, other):
    """Equal to the bit."""
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_the_mean_action_is_the_imitated_one_and_the_value_is_another_readout():
    for preset in ("best", "thesis-ch5"):
        actor = swarm_actor_critic(model(preset), gamma=0.9, initial_std=0.2)
        state = task().env.reset(scene_keys(1, range(4)))
        observation = task().observe(state)
        params = jax.jit(actor.init)(jax.random.key(1), observation)
        apply = jax.jit(actor.apply)
        mean, value = apply(params, observation)
        imitated = jax.jit(make_policy(model(preset).config, model(preset).scales))(state, model(preset).params)
        np.testing.assert_allclose(mean, imitated, atol=1e-5)
        assert value.shape == mean.shape[:2]
        same(network_weights(params), model(preset).params)
        here = np.asarray(state.agent_present)
        assert not here.all()
        for whole, each in zip((mean, value), apply(params, jax.jit(actor.views)(observation)), strict=True):
            np.testing.assert_allclose(each.reshape(whole.shape)[here], whole[here], atol=1e-5)
        np.testing.assert_allclose(params[STD], np.log(0.2 * task().env.spec.max_acceleration), rtol=1e-6)
        other = params | {VALUE: jax.tree.map(lambda x: x + 1, params[VALUE])}
        moved_mean, moved_value = apply(other, observation)
        same(moved_mean, mean)
        assert not np.allclose(moved_value, value)
    random = swarm_actor_critic(model(), gamma=0.9, initial_std=0.2, scratch=True)
    scratch = jax.jit(random.init)(jax.random.key(1), observation)
    kernels = [p["edge"]["agent"]["layer0"]["kernel"] for p in (scratch, model().params)]
    assert not np.allclose(*kernels)


def test_contacts_end_episodes_in_the_first_iterations_alone():
    config = replace(CONFIG, steps=6, terminations=2)
    actor, here = swarm_actor_critic(model(), gamma=0.9, initial_std=0.2), task(terminate=True)
    runner = jax.jit(lambda: start(here, config, jnp.arange(config.scenes)))()
    params = jax.jit(lambda: actor.init(jax.random.key(1), here.observe(runner.world)))()
    found = jax.jit(lambda number: collect(here, actor, params, runner, config, number)[1])
    first, later = found(jnp.int32(1)), found(jnp.int32(2))
    touched = np.asarray(first.measures["contact_events"]).any(axis=2)
    assert touched.any()
    assert not touched.all()
    np.testing.assert_array_equal(first.terminated, touched & first.valid)
    assert not later.terminated.any()
    assert np.asarray(later.measures["contact_events"]).any()
    # All started together, and nothing else ends an episode before the horizon.
    np.testing.assert_array_equal(later.ended, np.broadcast_to(np.arange(6)[:, None] == 5, (6, 6)))


def test_worlds_without_a_goal_contacts_or_a_limit():
    """No goal, nothing paid for one; a price on contacts that are off, or an endless exploration, is refused."""

    def of(preset, reward=None):
        world = SimulateConfig(preset=preset, num_agents=2).world()
        return SwarmTask(SwarmEnv(world.scene, spawn=world.spawn, engine="native"), reward)

    free = RewardConfig(collision=0.0)
    chaser = of("chaser", free)
    world, _ = chaser.start(scene_keys(0, np.arange(3)))
    terms = chaser.step(world, jnp.zeros((3, 2, 2))).measures
    assert not np.asarray(terms["reward_goal"]).any()
    assert np.asarray(of("clear").step(*started(of("clear"))).measures["reward_goal"]).any()
    with pytest.raises(SpecError, match=r"contacts.*False.*on, as in preset clear"):
        of("published")
    with pytest.raises(SpecError, match=r"max_acceleration.*inf"):
        of("vicsek", free)


def started(task):
    world, _ = task.start(scene_keys(0, np.arange(3)))
    return world, jnp.zeros((3, 2, 2))


def test_a_model_that_does_not_steer_is_refused():
    historic = replace(model(), config=tiny("thesis-ch3"))
    for other in (historic, replace(model(), config=tiny("separable"))):
        with pytest.raises(SwarmError, match="PPO"):
            swarm_actor_critic(other, gamma=0.9, initial_std=0.2)


def test_interrupted_and_gone_on_is_as_if_nothing_had_happened(tmp_path):
    """Train 4 = train 2, copy what is there, go on to 4; scenes under way, resets and exploration included."""
    whole = train(CONFIG, task(), model(), tmp_path / "whole")
    train(replace(CONFIG, iterations=2), task(), model(), tmp_path / "half")
    shutil.copytree(tmp_path / "half", tmp_path / "rest")
    rest = train(CONFIG, task(), model(), tmp_path / "rest")
    same(whole.params, rest.params)
    same(load_model(tmp_path / "rest" / "checkpoints").params, whole.params)
    assert not np.allclose(whole.params["readout"]["layer0"]["kernel"], model().params["readout"]["layer0"]["kernel"])
    assert whole.about["step"] == rest.about["step"] == 4
    with pytest.raises(CheckpointError, match="rl differ"):
        train(replace(CONFIG, gamma=0.5), task(), model(), tmp_path / "rest")
    with pytest.raises(CheckpointError, match="reward"):
        train(CONFIG, SwarmTask(task().env, RewardConfig(collision=1.0)), model(), tmp_path / "rest")


def test_frozen_leaves_stay_to_the_bit_in_mode_2_with_imitation_weight(tmp_path):
    config = replace(
        CONFIG, iterations=2, warmup=0, freeze=("edge/goal/*", "node/*", "readout/*"), imitation_weight=0.5
    )
    found = train(config, task(), model(), tmp_path)
    for part in ("node", "readout"):
        same(found.params[part], model().params[part])
    same(found.params["edge"]["goal"], model().params["edge"]["goal"])
    for kind in ("obstacle", "agent"):
        kernels = [p["edge"][kind]["layer0"]["kernel"] for p in (found.params, model().params)]
        assert not np.array_equal(*kernels)
    with pytest.raises(SpecError, match="freeze"):
        train(replace(config, freeze=("nothing/*",)), task(), model(), tmp_path / "other")


def test_an_update_that_is_not_finite_is_refused_and_the_weights_before_it_stay(tmp_path):
    mad = SwarmTask(task().env, RewardConfig(collision=1e38, goal_gain=1e38))
    with pytest.raises(RLError, match="not finite and was refused"):
        train(replace(CONFIG, warmup=0), mad, model(), Path(tmp_path))
    kept = load_model(tmp_path / "checkpoints")
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(kept.params))
    same(kept.params, model().params)


class Diverging(Probe):
    """A probe of which the scenes with a negative first sign break in their second step."""

    def step(self, world, action):
        """One step."""
        outcome = super().step(world, action)
        sick = (world.step == 1) & (world.sign[:, 0] < 0)
        broken = replace(outcome.world, sign=jnp.where(sick[:, None], jnp.nan, outcome.world.sign))
        return replace(outcome, world=broken, diverged=sick, reward=jnp.where(sick[:, None], jnp.nan, outcome.reward))


def test_a_scene_that_diverges_is_started_anew_and_counted():
    probe, actor = Diverging(lambda sign, action, last: sign, length=4), probe_actor()
    config = replace(CONFIG, scenes=16, steps=8, warmup=0)
    runner = start(probe, config, jnp.arange(16))
    params = actor.init(jax.random.key(0), probe.observe(runner.world))
    runner, rollout = jax.jit(lambda p, r: collect(probe, actor, p, r, config, jnp.int32(0)))(params, runner)
    broke = np.asarray(rollout.diverged)
    assert broke.any()
    np.testing.assert_array_equal(np.asarray(rollout.valid)[broke], False)
    np.testing.assert_array_equal(np.asarray(rollout.ended)[broke], True)
    for leaf in jax.tree.leaves((rollout, runner)):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()
    # The restart that follows: a fresh scene of the slot.
    t, s = np.argwhere(broke[:-2])[0]
    np.testing.assert_array_equal(rollout.valid[t + 1 : t + 3, s], [False, True])
    learner = make_learner(probe, actor, config)
    state, row = learner.iterate(learner.start())
    assert float(row["diverged"]) == broke.sum()
    assert float(row["finite"]) == 1
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(state["params"]))


def test_fresh_scenes_at_every_reset_and_rewards_of_the_episode():
    """Slot i runs scenes i, i + S, ...; the return is the sum of the rewards of its agents, by hand."""
    probe, actor = Probe(lambda sign, action, last: sign, length=3), probe_actor()
    config = replace(CONFIG, scenes=4, steps=12)
    runner = start(probe, config, jnp.arange(4))
    params = actor.init(jax.random.key(0), probe.observe(runner.world))
    after, rollout = jax.jit(lambda p, r: collect(probe, actor, p, r, config, jnp.int32(0)))(params, runner)
    np.testing.assert_array_equal(after.scene, np.arange(4) + 3 * 4)  # 12 rows: three times 3 steps and a restart
    fresh, _ = probe.start(jax.vmap(lambda n: jax.random.fold_in(jax.random.key(config.seed), n))(after.scene))
    np.testing.assert_array_equal(after.world.sign, fresh.sign)
    reward, present = np.asarray(rollout.reward), np.asarray(rollout.present)
    by_hand = reward[:3].sum((0, 2)) / present[0].sum(1)
    np.testing.assert_allclose(rollout.gained[2], by_hand, rtol=1e-6)
    np.testing.assert_array_equal(rollout.valid[:, 0], [True, True, True, False] * 3)


def test_two_compiled_iterations_on_mjx_with_contacts_and_resets():
    """Its rollout is native's under the same actions: the same seeds, and contacts up to borderline ones."""
    config = replace(CONFIG, steps=8, iterations=2)
    rows, states = {}, {}
    for engine in ("native", "mjx"):
        one = task(engine, terminate=True)
        actor = swarm_actor_critic(model(), gamma=config.gamma, initial_std=0.4)
        learner = make_learner(one, actor, config)
        state = learner.start()
        for _ in range(2):
            state, row = learner.iterate(state)
        rows[engine], states[engine] = {k: float(v) for k, v in row.items()}, state
        assert rows[engine]["finite"] == 1
        assert rows[engine]["episodes"] > 0
        assert learner.iterate._cache_size() == 1
    for name in ("reward", "goal_distance", "episodes", "kl", "contact_events"):
        np.testing.assert_allclose(rows["mjx"][name], rows["native"][name], rtol=1e-2, atol=1e-3, err_msg=name)
    worlds = [states[engine]["runner"].world for engine in ("native", "mjx")]
    np.testing.assert_array_equal(worlds[0].step, worlds[1].step)
    np.testing.assert_allclose(worlds[0].position, worlds[1].position, atol=2e-2)


def test_the_command_says_what_is_wrong(tmp_path, capsys):
    for arguments, message in (
        ([str(tmp_path), "--run", str(tmp_path)], "run: .* allowed is another folder"),
        ([str(tmp_path / "none")], "no such checkpoint folder"),
        ([str(tmp_path), "--minutes", "0"], "minutes: 0.0 was given"),
        ([str(tmp_path), "--steps", "30"], "minibatches: 4 was given, allowed is a divisor of steps = 30"),
        ([str(tmp_path), "--reward.collision", "-1"], "collision: -1.0 was given"),
    ):
        try:
            code = main(["rl", *arguments])
        except SystemExit as refused:  # of a value that the parser refuses
            code = refused.code
        assert code == 2
        assert re.search(message, " ".join(capsys.readouterr().err.split())), message
