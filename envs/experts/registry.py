"""From an expert's configuration to its policy."""

from envs.experts.boids import boids
from envs.experts.chaser import chaser
from envs.experts.config import BoidsConfig, ChaserConfig, ExpertConfig, HelbingConfig, VicsekConfig
from envs.experts.helbing import helbing
from envs.experts.vicsek import vicsek
from envs.policy import Policy


def make_expert(config: ExpertConfig) -> Policy:
    """The expert `(state, params, key) -> acceleration` of a configuration."""
    match config:
        case BoidsConfig():
            return boids(config)
        case HelbingConfig():
            return helbing(config)
        case ChaserConfig():
            return chaser(config)
        case VicsekConfig():
            return vicsek(config)
