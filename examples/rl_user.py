# %% [markdown]
# # A swarm as a Gymnasium vector environment
#
# One call steps all scenes in MuJoCo; rewards are those of the thesis (eq. 5.26-5.27). A policy with one weight for
# each vector that an agent sees is learned by an evolution strategy: each scene tries its own perturbation of them.

# %%
import sys

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

from envs.adapters import register
from envs.config import make_world
from envs.experts import make_expert

SCENES = int(sys.argv[1]) if __name__ == "__main__" and len(sys.argv) == 2 else 128
GENERATIONS, STEP, SPREAD = 25, 1.0, 0.5

# %% [markdown]
# Observations are (scenes, agents, numbers) in SI units with finite bounds; actions are accelerations in [-1, 1],
# scaled by the scene's limit. Every number has a label.

# %%
register()
swarm = {"num_agents": 3, "horizon": 40, "terminate_on_contact": False}
env = gymnasium.make_vec("SwarmNet/Swarm-v0", num_envs=SCENES, **swarm)
core = env.unwrapped.core
print(env.observation_space.shape, env.action_space.shape)
print(core.observation.labels[:10])


# %%
def play(act, seed, scenes=None):
    """The return of every scene, and steps in contact per agent and episode; `scenes` chooses scenes of the seed."""
    seen, _ = env.reset(seed=seed, options={"scenes": scenes})
    total, touched = np.zeros(SCENES), 0.0
    for _ in range(swarm["horizon"]):
        seen, reward, _, _, infos = env.step(act(seen))
        total += reward
        touched += (infos["agent_contacts"] + infos["solid_contacts"] > 0).mean()
    return total, touched


x = np.array([i for i, label in enumerate(core.observation.labels) if "x [" in label])
scale = env.single_observation_space.high[0, x]
print([core.observation.labels[i] for i in x])


def linear(weights):
    """One weight per vector that an agent sees, (K,), or such a row per scene -> policy."""

    def act(seen):
        vectors = np.stack([seen[..., x], seen[..., x + 1]], axis=-1) / scale[:, None]
        return np.tanh(5 * np.einsum("snkd,sk->snd", vectors, np.broadcast_to(weights, (SCENES, len(x)))))

    return act


# %%
rng = np.random.default_rng(0)
weights, history = np.zeros(len(x)), []
for generation in range(GENERATIONS):
    half = rng.normal(size=(SCENES // 2, len(x)))
    noise = np.concatenate([half, -half])  # pairs that differ in sign, in the same scene
    returns, _ = play(linear(weights + SPREAD * noise), generation, np.arange(SCENES) % (SCENES // 2))
    better = np.subtract(*np.split(returns, 2))  # the same scenes, the perturbation and its opposite
    weights = weights + STEP * np.sign(better) @ half / len(half)
    history.append(returns.mean())
print(dict(zip(("own velocity", "goal"), weights.round(2).tolist(), strict=False)))

# %% [markdown]
# The same unseen scenes, played by chance, by what was learned and by the expert: any policy of the project acts
# through `core.acting`.

# %%
expert = core.acting(make_expert(make_world("clear").expert))
policies = {
    "random": lambda seen: rng.uniform(-1, 1, env.action_space.shape).astype(np.float32),
    "learned": linear(weights),
    "expert": lambda seen: np.asarray(expert(env.unwrapped.state)),
}
for name, policy in policies.items():
    returns, touched = play(policy, 10_000)
    print(f"{name:8} return {returns.mean():6.2f}  steps in contact per agent and episode {touched:.2f}")

# %%
figure, axes = plt.subplots(figsize=(5, 2.6), layout="constrained")
axes.plot(history)
axes.set(xlabel="generation", ylabel="mean return per agent")
figure.savefig("rl_user.png", dpi=80)
