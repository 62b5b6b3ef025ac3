"""Presets of the rivals, as plain data. Standard library only."""

from dataclasses import dataclass

from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class BaselineConfig:
    """One rival; each family has its own fields."""

    window: int = 10
    """States the model sees: the present one and `window - 1` before it."""
    hidden: int = 256
    """Width of every hidden layer and recurrent state."""

    @property
    def acts(self) -> bool:
        """Rivals predict states; they steer nobody."""
        return False

    def __post_init__(self) -> None:
        for field in ("window", "hidden"):
            if getattr(self, field) < 1:
                raise SpecError(field, getattr(self, field), "at least 1")


@dataclass(frozen=True, kw_only=True)
class KipfConfig(BaselineConfig):
    """Neural relational inference (Kipf et al. 2018): latent edge types from a window, then message passing."""

    edge_types: int = 2
    """Latent edge types."""
    temperature: float = 0.5
    """Of the Gumbel-softmax in training."""
    variance: float = 5e-5
    """Fixed variance of the Gaussian output, in squared one-step changes of the data (the loss's unit)."""
    skip_first: bool = False
    """Whether edges of the first type carry no message."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.edge_types < 2:
            raise SpecError("edge_types", self.edge_types, "at least 2: with one there is nothing to infer")
        for field in ("temperature", "variance"):
            if not getattr(self, field) > 0:
                raise SpecError(field, getattr(self, field), "above 0")


@dataclass(frozen=True, kw_only=True)
class DecoderConfig(BaselineConfig):
    """Kipf's decoder alone on the known graph (table 3.2)."""

    window: int = 1
    """States the model sees; 2 * layers + 1 with convolutions."""
    hidden: int = 64
    """Width of every hidden layer; SwarmNet's, so that table 3.2 compares structure."""
    convolutions: tuple[int, ...] = ()
    """Filters of the 1D convolutions over the window, kernel 3, no padding."""
    context: bool = False
    """Whether goals and obstacles send messages of their own types, or agents alone do."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window != 2 * len(self.convolutions) + 1:
            raise SpecError("window", self.window, f"{2 * len(self.convolutions) + 1} with these convolutions")


@dataclass(frozen=True, kw_only=True)
class LSTMConfig(BaselineConfig):
    """Joint LSTM (baseline of Kipf et al. 2018): all agents' states side by side, 2-layer MLP, LSTM, 2-layer MLP."""


@dataclass(frozen=True, kw_only=True)
class Seq2SeqConfig(BaselineConfig):
    """Encoder and decoder LSTM over the joint state (Sutskever et al. 2014)."""

    layers: int = 2
    """LSTM layers of the encoder and of the decoder."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.layers < 1:
            raise SpecError("layers", self.layers, "at least 1")


PRESETS: dict[str, BaselineConfig] = {
    # Tables 3.1, 3.2, 4.1. The paper encodes 49 rows; ten leave room for 40 predicted ones in 50 recorded rows.
    "kipf": KipfConfig(),
    # Table 3.2, from Kipf's decoder towards SwarmNet.
    "kipf-decoder": DecoderConfig(),
    "kipf-decoder-context": DecoderConfig(context=True),
    "kipf-decoder-conv1d": DecoderConfig(window=5, convolutions=(32, 64)),
    "kipf-decoder-conv1d-context": DecoderConfig(window=5, convolutions=(32, 64), context=True),
    # Tables 3.1 and 4.1: one input per agent, so each is of use at its own size alone.
    "lstm": LSTMConfig(),
    "seq2seq": Seq2SeqConfig(),
}
