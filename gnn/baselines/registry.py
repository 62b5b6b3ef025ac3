"""From a rival's preset to its functions."""

from gnn.baselines.config import BaselineConfig, DecoderConfig, KipfConfig, LSTMConfig, Seq2SeqConfig
from gnn.baselines.decoder import make_decoder
from gnn.baselines.kipf import make_kipf
from gnn.baselines.lstm import make_lstm
from gnn.baselines.seq2seq import make_seq2seq
from gnn.decode import Integrator
from gnn.family import Family
from gnn.features import Scales
from swarm_mjcf.errors import SpecError


def make_baseline(config: BaselineConfig, scales: Scales, integrator: Integrator) -> Family:
    """Initial weights, prediction and loss of a rival. Raises SpecError for a configuration of no known family."""
    match config:
        case KipfConfig():
            return make_kipf(config, scales, integrator)
        case DecoderConfig():
            return make_decoder(config, scales, integrator)
        case LSTMConfig():
            return make_lstm(config, scales, integrator)
        case Seq2SeqConfig():
            return make_seq2seq(config, scales, integrator)
    raise SpecError("model", config, "a KipfConfig, DecoderConfig, LSTMConfig or Seq2SeqConfig")
