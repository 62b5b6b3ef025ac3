"""From an expert's configuration to its policy."""

from envs.experts.config import ExpertConfig
from envs.policy import Policy


def make_expert(config: ExpertConfig) -> Policy:
    """The expert `(state, params, key) -> acceleration` of a configuration."""
    from envs.experts.boids import boids

    return boids(config)
