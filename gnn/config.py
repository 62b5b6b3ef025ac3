"""Presets of the model family and of its training, as plain data. Standard library only."""

from dataclasses import dataclass, replace
from typing import Literal

from swarm_mjcf.errors import SpecError


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """One member of the SwarmNet family; `PRESETS` has the three that matter."""

    window: int = 1
    """States the model sees: the present one and `window - 1` before it."""
    convolutions: tuple[int, ...] = ()
    """Filters of the 1D convolutions over the window, kernel 3, no padding: window = 2 * layers + 1."""
    relative: bool = False
    """Whether edge functions see relative positions and velocities besides the raw ones."""
    normalise: bool = False
    """Whether inputs and outputs are scaled by statistics of the training data, stored with the weights."""
    edge_hidden: tuple[int, ...] = (64, 64)
    """Hidden ReLU layers of each edge function; a linear layer `message` wide follows."""
    message: int = 64
    """Width of a message."""
    aggregate: tuple[Literal["sum", "mean", "max"], ...] = ("sum",)
    """How messages of all senders are joined; more than one: side by side, each edge type for itself."""
    psi: bool = False
    """Whether the sum passes an MLP of its own (equation 3.2)."""
    node_hidden: tuple[int, ...] = (64, 64)
    """Hidden ReLU layers of the node function."""
    output: Literal["acceleration", "state_change"] = "acceleration"
    """What the readout means: an acceleration for the integrator (eq. 5.28), or the change of the state (chapter 3)."""
    clip: bool = False
    """Whether the decoder applies the limits of speed and acceleration."""

    def __post_init__(self) -> None:
        if self.window != 2 * len(self.convolutions) + 1:
            raise SpecError("window", self.window, f"{2 * len(self.convolutions) + 1} with these convolutions")
        if not self.aggregate:
            raise SpecError("aggregate", self.aggregate, "at least one of sum, mean, max")


PRESETS: dict[str, ModelConfig] = {
    # Chapter 3 as written: history by Conv1D, typed edge functions on raw states, psi on the sum, state change.
    "thesis-ch3": ModelConfig(window=5, convolutions=(32, 64), psi=True, output="state_change"),
    # Chapter 5 (eq. 5.22-5.28): one state, plain sum, acceleration. Scaling is affine: inputs stay linear in the state.
    "thesis-ch5": ModelConfig(normalise=True),
    # Ours.
    "best": ModelConfig(relative=True, normalise=True, aggregate=("sum", "mean", "max"), clip=True),
}


def model_preset(name: str) -> ModelConfig:
    """A preset by name. Raises SpecError for a name that does not exist."""
    if name not in PRESETS:
        raise SpecError("model", name, "one of " + ", ".join(PRESETS))
    return PRESETS[name]


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Imitation: multi-step loss over a curriculum of horizons, Adam, cosine learning rate."""

    model: str = "best"
    """Preset of the model: thesis-ch3, thesis-ch5, best."""
    seed: int = 0
    """Initial weights and data order."""
    horizons: tuple[int, ...] = (1, 2, 5, 10)
    """Predicted steps in each stage of the curriculum."""
    stage_steps: tuple[int, ...] = (5000, 2500, 1500, 1000)
    """Gradient steps in each stage."""
    batch: int = 128
    """Windows per gradient step."""
    learning_rate: float = 2e-3
    """Peak of the cosine schedule of Adam."""
    clip_norm: float = 1.0
    """Largest global norm of a gradient."""
    noise: float = 0.0
    """Standard deviation of noise on the first input state, in one-step changes of the data."""
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

    @property
    def steps(self) -> int:
        """Gradient steps in all."""
        return sum(self.stage_steps)

    def scaled(self, factor: float) -> "TrainConfig":
        """The same curriculum with `factor` times the steps, in whole chunks."""
        steps = tuple(max(1, round(n * factor / self.chunk)) * self.chunk for n in self.stage_steps)
        return replace(self, stage_steps=steps)
