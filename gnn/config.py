"""Presets of the model family and of its training, as plain data. Standard library only."""

import math
from dataclasses import dataclass, replace
from typing import Literal

from gnn.baselines.config import PRESETS as BASELINE_PRESETS
from gnn.baselines.config import BaselineConfig
from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """One member of the SwarmNet family; `PRESETS` has those that matter."""

    window: int = 1
    """States the model sees: the present one and `window - 1` before it."""
    convolutions: tuple[int, ...] = ()
    """Filters of the 1D convolutions over the window, kernel 3, no padding: window = 2 * layers + 1."""
    context: bool = True
    """Whether goals and obstacles act on the agents (chapter 3's "context")."""
    frame: bool = False
    """Whether edge functions see only relative quantities, turned so that the receiver moves along x, and the readout
    is turned back: where the world is and which way it faces then matters to the node function alone."""
    additive: bool = False
    """Whether messages are forces, whose sum the readout passes on; the node function then adds what depends on the
    place alone. Needs `frame` and a `message` of 2."""
    skip: bool = False
    """Whether every function has a linear path beside its hidden layers."""
    normalise: bool = False
    """Whether inputs and outputs are scaled by statistics of the training data, stored with the weights."""
    edge_hidden: tuple[int, ...] = (64, 64)
    """Hidden ReLU layers of each edge function; a linear layer `message` wide follows."""
    edge_bias: bool = True
    """Whether the layers of edge functions have biases."""
    message: int = 64
    """Width of a message."""
    aggregate: tuple[Literal["sum", "near", "mean", "max"], ...] = ("sum",)
    """How messages of all senders are joined, side by side: their sum, the sum over near senders with a learned reach,
    and mean and max of each edge type for itself."""
    psi: bool = False
    """Whether the sum passes an MLP of its own (equation 3.2)."""
    node_hidden: tuple[int, ...] = (64, 64)
    """Hidden ReLU layers of the node function."""
    nearest: int | None = None
    """Agents see only this many other agents, the nearest of those they have edges from."""
    dropout: float = 0.0
    """Share of hidden neurons that a stochastic forward pass drops."""
    output: Literal["acceleration", "state_change"] = "acceleration"
    """What the readout means: an acceleration for the integrator (eq. 5.28), or the change of the state (chapter 3)."""
    clip: bool = False
    """Whether the decoder applies the limits of speed and acceleration."""

    @property
    def acts(self) -> bool:
        """Whether it steers from the present state alone, so that physics can execute it."""
        return self.window == 1 and self.output == "acceleration"

    def __post_init__(self) -> None:
        if self.window != 2 * len(self.convolutions) + 1:
            raise SpecError("window", self.window, f"{2 * len(self.convolutions) + 1} with these convolutions")
        if self.frame and (self.window != 1 or self.output != "acceleration"):
            raise SpecError("frame", True, "False with a history window or state changes: it turns accelerations")
        if self.additive and not (self.frame and self.message == 2 and not self.psi):
            raise SpecError("additive", True, "False without frame, without a message of 2, or with psi")
        if self.nearest is not None and self.nearest < 1:
            raise SpecError("nearest", self.nearest, "at least 1, or None")
        if not 0 <= self.dropout < 1:
            raise SpecError("dropout", self.dropout, "a share from 0 up to 1")
        if not self.aggregate or not set(self.aggregate) <= {"sum", "near", "mean", "max"}:
            raise SpecError("aggregate", self.aggregate, "at least one of sum, near, mean, max")


_BEST = ModelConfig(frame=True, skip=True, normalise=True, message=32, aggregate=("near", "mean"), clip=True)

PRESETS: dict[str, ModelConfig] = {
    # Chapter 3 as written: history by Conv1D, typed edge functions on raw states, psi on the sum, state change.
    "thesis-ch3": ModelConfig(window=5, convolutions=(32, 64), psi=True, output="state_change"),
    "thesis-ch3-blind": ModelConfig(window=5, convolutions=(32, 64), psi=True, output="state_change", context=False),
    # Chapter 5 (eq. 5.22-5.28): one state, plain sum, acceleration. Scaling is affine: inputs stay linear in the state.
    "thesis-ch5": ModelConfig(normalise=True),
    # The same with fewer weights, for which mixed-integer programs and Gram matrices of whole parts stay small.
    "thesis-ch5-small": ModelConfig(normalise=True, edge_hidden=(32, 32), message=16, node_hidden=(32, 32)),
    # Ours; with dropout, for uncertainty (SwarmNet+); with forces for messages, which separates the edge functions;
    # for crowds, where everybody sees only the nearest.
    "best": _BEST,
    "best-plus": replace(_BEST, dropout=0.1),
    "separable": replace(_BEST, additive=True, message=2),
    "crowd": replace(_BEST, nearest=10),
    # What aggregation is worth (section 4.1).
    "best-sum": replace(_BEST, aggregate=("sum",)),
    "best-mean": replace(_BEST, aggregate=("mean",)),
    "best-max": replace(_BEST, aggregate=("max",)),
    "best-all": replace(_BEST, aggregate=("sum", "mean", "max")),
    # What separates the edge functions (section 5.6.2): from both ends, one thing changed.
    "best-world": replace(_BEST, frame=False),
    "best-hidden": replace(_BEST, skip=False),
    "best-narrow": replace(_BEST, message=2),
    "best-unbiased": replace(_BEST, edge_bias=False),
    "thesis-ch5-frame": ModelConfig(normalise=True, frame=True),
    "thesis-ch5-mean": ModelConfig(normalise=True, aggregate=("mean",)),
    "thesis-ch5-narrow": ModelConfig(normalise=True, message=2),
    "thesis-ch5-unbiased": ModelConfig(normalise=True, edge_bias=False),
}


AnyModelConfig = ModelConfig | BaselineConfig


def model_preset(name: str) -> AnyModelConfig:
    """A preset by name, of SwarmNet or a rival. Raises SpecError for a name that does not exist."""
    known: dict[str, AnyModelConfig] = PRESETS | BASELINE_PRESETS
    if name not in known:
        raise SpecError("model", name, "one of " + ", ".join(known))
    return known[name]


def config_kinds() -> dict[str, type[AnyModelConfig]]:
    """The classes of model configurations by name, as checkpoints spell them."""
    return {kind.__name__: kind for kind in (ModelConfig, *map(type, BASELINE_PRESETS.values()))}


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Imitation: multi-step loss over a curriculum of horizons, Adam, cosine learning rate."""

    model: str = "best"
    """Preset of the model: best, thesis-ch5, thesis-ch3, thesis-ch3-blind (no context), or a rival's."""
    seed: int = 0
    """Initial weights and data order."""
    horizons: tuple[int, ...] = (1, 2, 5, 10)
    """Predicted steps in each stage of the curriculum."""
    stage_steps: tuple[int, ...] = (9000, 500, 300, 200)
    """Gradient steps in each stage."""
    batch: int = 128
    """Windows per gradient step."""
    learning_rate: float = 2e-3
    """Peak of the cosine schedule of Adam."""
    clip_norm: float = 1.0
    """Largest global norm of a gradient."""
    noise: float = 0.0
    """Standard deviation of noise on the first input state, in one-step changes of the data."""
    average: float = 0.999
    """Decay per step (0.999, say) of a running mean of the weights, which the trained model then has; 0: it has the
    last weights."""
    chunk: int = 100
    """Gradient steps per compiled call; training only ever stops between chunks."""
    checkpoint_seconds: float = 60.0
    """Longest time between checkpoints [s]."""

    def __post_init__(self) -> None:
        model_preset(self.model)
        for field in ("batch", "chunk"):
            if getattr(self, field) < 1:
                raise SpecError(field, getattr(self, field), "at least 1")
        if len(self.horizons) != len(self.stage_steps) or not self.horizons:
            raise SpecError("stage_steps", self.stage_steps, f"one number per horizon of {self.horizons}")
        if min(self.horizons) < 1:
            raise SpecError("horizons", self.horizons, "at least 1 step each")
        for steps in self.stage_steps:
            if steps < self.chunk or steps % self.chunk:
                raise SpecError("stage_steps", self.stage_steps, f"multiples of chunk = {self.chunk}, at least one")
        for field in ("learning_rate", "clip_norm", "checkpoint_seconds"):
            if not getattr(self, field) > 0:
                raise SpecError(field, getattr(self, field), "above 0")
        if self.noise < 0:
            raise SpecError("noise", self.noise, "at least 0")
        if not 0 <= self.average < 1:
            raise SpecError("average", self.average, "from 0 up to 1")

    @property
    def steps(self) -> int:
        """Gradient steps in all."""
        return sum(self.stage_steps)

    def scaled(self, factor: float) -> "TrainConfig":
        """The same curriculum with `factor` times the steps, in whole chunks. Raises SpecError."""
        if not 0 < factor < math.inf:
            raise SpecError("scale", factor, "a finite number above 0")
        steps = tuple(max(1, round(n * factor / self.chunk)) * self.chunk for n in self.stage_steps)
        return replace(self, stage_steps=steps)
