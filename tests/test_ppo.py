"""PPO on tasks with known answers, and each of its parts against numbers by hand or a second implementation."""

from functools import cache
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learning import quick_compiles
from probes import AGENTS, Probe, probe_actor

from gnn.freeze import frozen, paths_of
from rl.actor_critic import entropy, log_probability
from rl.collect import collect, start
from rl.config import MODES, PPOConfig
from rl.gae import gae
from rl.ppo import by_agent, gradient, losses, make_optimizer, make_samples, mean_and_variance, units
from rl.train import make_learner
from swarm_mjcf.errors import SpecError

FAST = PPOConfig(
    scenes=64, steps=8, iterations=60, warmup=0, epochs=4, minibatches=2, learning_rate=1e-2, gamma=0.9, target_kl=1.0
)


@pytest.fixture(autouse=True, scope="module")
def _quickly():
    with quick_compiles():
        yield


SIGNS = jnp.asarray([[[-1.0], [1.0]]])


def learned(probe, config=FAST):
    """`(mean actions, values)` at the signs -1 and +1 after training, and the metrics of the last iteration."""
    actor = probe_actor()
    learner = make_learner(probe, actor, config)
    state, row = learner.start(), {}
    for _ in range(config.iterations):
        state, row = learner.iterate(state)
    mean, value = actor.apply(state["params"], SIGNS)
    return np.asarray(mean[0, :, 0]), np.asarray(value[0]), row


def test_a_constant_reward_is_its_value():
    _, value, row = learned(Probe(lambda sign, action, last: jnp.ones_like(sign)))
    np.testing.assert_allclose(value, [1, 1], atol=0.05)
    assert float(row["return"]) == pytest.approx(1)


def test_a_reward_that_can_be_seen_is_told_apart():
    _, value, row = learned(Probe(lambda sign, action, last: sign))
    np.testing.assert_allclose(value, [-1, 1], atol=0.05)
    assert float(row["explained_variance"]) > 0.95


def test_a_delayed_reward_is_discounted_by_the_steps_before_it():
    """Paid in the second of two steps, which look alike: the value is the mean of gamma * 1 and 1."""
    config = PPOConfig(**{**vars(FAST), "minibatches": 1, "learning_rate": 3e-3, "iterations": 150})
    _, value, _ = learned(Probe(lambda sign, action, last: jnp.where(last, 1.0, 0.0) + 0 * sign, length=2), config)
    np.testing.assert_allclose(value, [0.95, 0.95], atol=0.03)


def test_truncation_bootstraps_from_the_last_observation_and_termination_does_not():
    """A reward of 1 for ever is worth 1 / (1 - gamma) = 10, though episodes are cut after 4 steps."""
    for truncates, worth in ((True, 10.0), (False, np.mean([3.439, 2.71, 1.9, 1.0]))):
        probe = Probe(lambda sign, action, last: jnp.ones_like(sign), length=4, truncates=truncates)
        _, value, _ = learned(probe, FAST if not truncates else PPOConfig(**{**vars(FAST), "iterations": 250}))
        np.testing.assert_allclose(value, [worth, worth], rtol=0.08)


def test_the_action_that_pays_is_found():
    mean, _, row = learned(Probe(lambda sign, action, last: -((action[..., 0] - 0.7) ** 2)))
    np.testing.assert_allclose(mean, [0.7, 0.7], atol=0.1)
    assert float(row["return"]) > -0.2


def test_the_action_that_pays_for_what_is_seen_is_found():
    mean, _, _ = learned(Probe(lambda sign, action, last: -((action[..., 0] - 0.5 * sign) ** 2)))
    np.testing.assert_allclose(mean, [-0.5, 0.5], atol=0.1)


def test_the_value_alone_learns_while_it_warms_up():
    config = PPOConfig(**{**vars(FAST), "warmup": 5, "iterations": 5})
    actor = probe_actor()
    learner = make_learner(Probe(lambda sign, action, last: -((action[..., 0] - 0.7) ** 2)), actor, config)
    first = state = learner.start()
    for _ in range(5):
        state, _ = learner.iterate(state)
    for name in ("mean", "log_std"):
        jax.tree.map(np.testing.assert_array_equal, state["params"][name], first["params"][name])
    assert not np.array_equal(
        state["params"]["value"]["layer0"]["kernel"], first["params"]["value"]["layer0"]["kernel"]
    )
    after, _ = learner.iterate(state)
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), after["params"], state["params"])
    assert moved["mean"]["layer0"]["kernel"] > 0
    # Adam's first steps are about the learning rate each: it has not counted the steps in which the actor stood still.
    assert moved["log_std"] < 1.5 * config.learning_rate * config.epochs * config.minibatches


def test_the_value_alone_learns_again_when_contacts_no_longer_end_episodes():
    config = PPOConfig(**{**vars(FAST), "warmup": 2, "terminations": 3})
    learner = make_learner(Probe(lambda sign, action, last: action[..., 0]), probe_actor(), config)
    states = [learner.start()]
    for _ in range(6):
        states.append(learner.iterate(states[-1])[0])
    moved = [
        not np.array_equal(*(state["params"]["mean"]["layer0"]["kernel"] for state in pair))
        for pair in pairwise(states)
    ]
    assert moved == [False, False, True, False, False, True]


def test_gae_by_hand():
    """gamma 0.9, lambda 0.5; the second of three steps is truncated: it takes the value of its last observation."""
    reward, value = jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([0.5, 1.0, 4.0, 2.0])
    follows = jnp.asarray([True, False, False])
    found = gae(reward, value, jnp.full(3, 0.9), follows, 0.5)
    last, second = 3 + 0.9 * 2 - 4, 2 + 0.9 * 4 - 1
    np.testing.assert_allclose(found, [1 + 0.9 - 0.5 + 0.45 * second, second, last], rtol=1e-6)
    terminated = gae(reward, value, jnp.asarray([0.9, 0.0, 0.9]), follows, 0.5)
    np.testing.assert_allclose(terminated[1], 2 - 1, rtol=1e-6)


def test_gae_is_that_of_rlax():
    """What rlax 0.1.9 gives: truncated_generalized_advantage_estimation(reward, discount, 0.9 * follows, value)."""
    reward, value = [1.0, -0.5, 2.0, 0.25, -1.0, 0.75], [0.5, 1.5, -1.0, 0.75, 2.0, -0.25, 1.25]
    discount, follows = 0.95 * jnp.asarray([1.0, 1, 0, 1, 1, 1]), jnp.asarray([True, True, False, True, False, True])
    found = gae(jnp.asarray(reward), jnp.asarray(value), discount, follows, 0.9)
    its = [1.5958248376846313, -0.38500016927719116, 3.0, -1.3680622577667236, -3.237499952316284, 2.1875]
    np.testing.assert_allclose(found, its, rtol=1e-6)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1))
def test_gae_is_the_weighted_sum_of_all_errors_ahead(seed, gamma, gae_lambda):
    """Equation 16 of Schulman et al. 2016, summed term by term."""
    rng = np.random.default_rng(seed)
    reward, value = rng.normal(size=(6, 2)), rng.normal(size=(7, 2))
    discount, follows = gamma * (rng.random((6, 2)) > 0.3), rng.random((6, 2)) > 0.3
    delta = reward + discount * value[1:] - value[:-1]
    expected = np.zeros((6, 2))
    for t in range(6):
        weight = np.ones(2)
        for k in range(t, 6):
            expected[t] += weight * delta[k]
            weight = weight * discount[k] * gae_lambda * follows[k]
    found = gae(*(jnp.asarray(x, jnp.float32) for x in (reward, value, discount)), jnp.asarray(follows), gae_lambda)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_the_density_and_the_entropy_of_an_action():
    mean, log_std, action = jnp.asarray([1.0, -1.0]), jnp.log(jnp.asarray([0.5, 2.0])), jnp.asarray([1.5, 3.0])
    by_hand = -0.5 * (1 + 4) - np.log(0.5) - np.log(2.0) - np.log(2 * np.pi)
    np.testing.assert_allclose(log_probability(mean, log_std, action), by_hand, rtol=1e-6)
    np.testing.assert_allclose(entropy(log_std), 1 + np.log(2 * np.pi), rtol=1e-6)


@cache
def samples_of(config=FAST):
    """A rollout's samples of a probe, with its actor and weights."""
    probe, actor = Probe(lambda sign, action, last: action[..., 0], length=3), probe_actor()
    runner = start(probe, config, jnp.arange(config.scenes))
    params = actor.init(jax.random.key(0), probe.observe(runner.world))
    _, rollout = jax.jit(lambda p, r: collect(probe, actor, p, r, config, jnp.int32(0)))(params, runner)
    return actor, params, rollout, make_samples(rollout, rollout.mean, config)


def terms_of(actor, params, samples, config):
    """Of a whole rollout as one minibatch."""
    return losses(actor, params, by_agent(actor, samples), config, units(samples, jnp.float32(1)))


def test_the_first_gradient_is_the_policy_gradient_whatever_the_clip():
    """At the policy that acted the ratio is 1: the gradient is that of mean(advantage * log probability)."""
    actor, params, _, samples = samples_of()
    config = PPOConfig(**{**vars(FAST), "value_weight": 0.0})
    found = jax.jit(jax.grad(lambda p: terms_of(actor, p, samples, config)[0]))(params)

    def plain(params):
        mean, _ = actor.apply(params, samples.observation)
        centre, variance = mean_and_variance(samples.advantage, samples.counts)
        advantage = (samples.advantage - centre) / (jnp.sqrt(variance) + 1e-8)
        gain = advantage * log_probability(mean, params["log_std"], samples.action)
        return -jnp.where(samples.counts, gain, 0).sum() / samples.counts.sum()

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), found, jax.jit(jax.grad(plain))(params))


def test_clipped_ratios_have_no_gradient():
    """One sample, advantage of the sign given, the ratio far outside: no pull where the clip forbids more."""
    actor, params, _, samples = samples_of()
    config = PPOConfig(**{**vars(FAST), "value_weight": 0.0, "clip": 0.1})
    for direction in (1.0, -1.0):
        # All actions were less likely by e when they were taken: every ratio is e.
        tilted = jax.tree.map(lambda x: x, samples)
        tilted = type(samples)(**{**vars(samples), "log_prob": samples.log_prob - 1.0})
        which = samples.advantage * direction > 0
        tilted = type(samples)(**{**vars(tilted), "counts": samples.counts & which})
        terms = terms_of(actor, params, tilted, config)[1]
        assert float(terms.clip_fraction) == 1
        np.testing.assert_allclose(float(terms.kl), np.e - 2, rtol=1e-5)


def test_ghosts_and_rows_without_experience_count_in_nothing():
    actor, params, rollout, samples = samples_of()
    assert not bool(samples.counts.all())
    rubbish = jnp.where(samples.counts, 0, 1e6)
    spoiled = type(samples)(
        **{
            **vars(samples),
            "advantage": samples.advantage + rubbish,
            "target": samples.target + rubbish,
            "action": samples.action + rubbish[..., None],
            "log_prob": samples.log_prob - rubbish,
        }
    )
    config = PPOConfig(**{**vars(FAST), "entropy_weight": 0.1, "imitation_weight": 0.1})
    for one, other in zip(
        *(
            jax.tree.leaves(jax.value_and_grad(lambda p, s=s: terms_of(actor, p, s, config), has_aux=True)(params))
            for s in (samples, spoiled)
        ),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    # Restarts follow the rows that ended, and only they.
    np.testing.assert_array_equal(~rollout.valid[1:], rollout.ended[:-1])


@pytest.mark.parametrize("chunk", [1, 100, 384, 10_000])
def test_the_gradient_is_the_sum_over_chunks_of_those_that_count(chunk):
    """Beside the gradient of the whole at once; some of the last chunk's places are empty."""
    actor, params, _, samples = samples_of()
    config = PPOConfig(**{**vars(FAST), "entropy_weight": 0.1, "imitation_weight": 0.1, "chunk": chunk})
    found, terms = jax.jit(lambda p: gradient(actor, p, samples, config, units(samples, jnp.float32(1))))(params)
    whole, whole_terms = jax.grad(lambda p: terms_of(actor, p, samples, config), has_aux=True)(params)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), (found, terms), (whole, whole_terms))


def test_agents_that_count_come_first_each_with_what_is_its_own():
    actor, _, _, samples = samples_of()
    agents, counts = by_agent(actor, samples), np.asarray(samples.counts)
    assert (np.asarray(agents.counts)[:, 0] == (np.arange(counts.size) < counts.sum())).all()
    for name in ("action", "target", "observation"):
        own = np.asarray(getattr(samples, name))[counts]
        np.testing.assert_array_equal(np.asarray(getattr(agents, name))[: counts.sum(), 0], own)


def test_normalised_advantages_have_mean_0_and_variance_1():
    _, _, _, samples = samples_of()
    mean, variance = mean_and_variance(samples.advantage, samples.counts)
    chosen = np.asarray(samples.advantage)[np.asarray(samples.counts)]
    np.testing.assert_allclose([mean, variance], [chosen.mean(), chosen.var()], rtol=1e-4)
    assert AGENTS * FAST.scenes * FAST.steps > len(chosen) > 0


def test_frozen_parts_stay_to_the_bit_and_count_in_no_norm():
    config = PPOConfig(**{**vars(FAST), "freeze": ("mean/layer0/*",), "iterations": 3})
    actor = probe_actor()
    learner = make_learner(Probe(lambda sign, action, last: action[..., 0]), actor, config)
    first = state = learner.start()
    for _ in range(3):
        state, _ = learner.iterate(state)
    jax.tree.map(np.testing.assert_array_equal, state["params"]["mean"]["layer0"], first["params"]["mean"]["layer0"])
    assert not np.array_equal(state["params"]["mean"]["layer1"]["kernel"], first["params"]["mean"]["layer1"]["kernel"])
    params = {"actor": {"a": jnp.zeros(2), "b": jnp.zeros(2)}, "value": jnp.zeros(2)}
    mask = {"actor": {"a": True, "b": False}, "value": False}
    gradient = {"actor": {"a": jnp.full(2, 1e9), "b": jnp.asarray([3.0, 4.0])}, "value": jnp.full(2, 1e9)}
    optimizer = make_optimizer(mask, PPOConfig(max_grad_norm=0.5))
    updates, state = optimizer.update(gradient, optimizer.init(params), params)
    np.testing.assert_array_equal(updates["actor"]["a"], 0)
    moments = [leaf for leaf in jax.tree.leaves(state.inner_states["actor"]) if np.shape(leaf) == (2,)]
    np.testing.assert_allclose(moments[0], 0.1 * np.asarray([0.3, 0.4]), rtol=1e-5)  # (3, 4) clipped to length 0.5
    assert optax.tree.norm(jax.tree.leaves(updates)[-1]) > 0


def test_an_update_ends_when_the_policy_has_moved_far_enough():
    probe = Probe(lambda sign, action, last: action[..., 0])
    for target, whole in ((1e-4, False), (1e3, True)):
        config = PPOConfig(**{**vars(FAST), "target_kl": target, "iterations": 1})
        learner = make_learner(probe, probe_actor(), config)
        _, row = learner.iterate(learner.start())
        assert (float(row["updates"]) == 1) is whole


def test_one_compile_for_all_iterations():
    learner = make_learner(Probe(lambda sign, action, last: sign), probe_actor(), FAST)
    state = learner.start()
    for _ in range(3):
        state, _ = learner.iterate(state)
    assert learner.iterate._cache_size() == 1


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("scenes", 0),
        ("minibatches", 7),
        ("gamma", 1.5),
        ("clip", 0.0),
        ("learning_rate", float("nan")),
        ("warmup", -1),
        ("terminations", -1),
        ("chunk", 0),
    ],
)
def test_absurd_settings_are_refused_by_name(field, value):
    with pytest.raises(SpecError, match=field):
        PPOConfig(**{field: value})


@pytest.mark.parametrize("reach", [{}, {"reach": {"goal": 0, "obstacle": 0, "agent": 0}}])
def test_the_modes_are_the_thesis_s(reach):
    """By what stays free, for a network as thesis-ch5 and one with a learned reach as best."""
    kinds = {kind: {"layer0": {"kernel": 0}} for kind in ("goal", "obstacle", "agent")}
    params = {"edge": kinds, "node": {"layer0": 0}, "readout": {"layer0": 0}, "value": 0, "log_std": 0, **reach}
    free = {}
    for mode, patterns in MODES.items():
        stays = jax.tree.leaves(frozen(params, patterns))
        free[mode] = {path for path, one in zip(paths_of(params), stays, strict=True) if not one}
    assert free[0] == set(paths_of(params))
    assert free[0] - free[1] == {path for path in free[0] if "goal" in path}
    assert free[1] - free[2] == {"node/layer0", "readout/layer0"}
