"""How does the law improve? Actor-critic on a SwarmNet, and PPO. Names are loaded on first use."""

from swarm_mjcf.lazy import lazy

_PUBLIC = {
    "MODES": "config",
    "PPOConfig": "config",
    "SwarmTask": "task",
    "gae": "gae",
    "make_learner": "train",
    "swarm_actor_critic": "actor_critic",
    "train": "train",
}
__getattr__, __dir__, __all__ = lazy(__name__, _PUBLIC)
