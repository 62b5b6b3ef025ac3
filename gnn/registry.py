"""From a preset's plain data to the functions of the model."""

from gnn.baselines.registry import make_baseline
from gnn.config import AnyModelConfig, ModelConfig
from gnn.decode import Integrator, make_predict, network_init
from gnn.family import Family, imitation_loss
from gnn.features import Scales


def make_family(config: AnyModelConfig, scales: Scales, integrator: Integrator) -> Family:
    """Initial weights, prediction and loss of a SwarmNet or a rival."""
    if not isinstance(config, ModelConfig):
        return make_baseline(config, scales, integrator)
    predict = make_predict(config, scales, integrator)
    return Family(network_init(config, scales), predict, imitation_loss(predict, scales))
