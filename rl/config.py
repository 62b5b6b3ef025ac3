"""Configuration of PPO. Standard library only."""

import math
from dataclasses import dataclass

from swarm_mjcf.errors import SpecError

MODES: dict[int, tuple[str, ...]] = {
    0: (),
    1: ("*/goal*",),
    2: ("*/goal*", "node/*", "readout/*"),
}
"""What a mode of section 5.6.3 keeps as it is: nothing; the goal's edge function (and the reach that preset `best` has
for it); all but those of obstacles and agents. The value's readout and the exploration are always free."""


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Proximal policy optimisation (Schulman et al. 2017) of a swarm's policy, every agent a learner."""

    seed: int = 0
    """Scenes, exploration, order of minibatches, first weights of the value's readout."""
    scenes: int = 64
    """Scenes under way at once."""
    steps: int = 60
    """Control steps of each scene between updates."""
    iterations: int = 100
    """Rollouts with an update each."""
    warmup: int = 8
    """First iterations, in which the value's readout alone learns."""
    terminations: int | None = None
    """First iterations in which a scene that the task ends (at a contact, with `terminate_on_contact`) is over; from
    then on all go on to the horizon, and the value's readout learns alone for another `warmup`. None: in all. An end
    at the contact tells clearly what was wrong; then a policy must still learn to come away from what it touches."""
    epochs: int = 2
    """Passes over each rollout."""
    minibatches: int = 4
    """Parts of a pass, by control steps; must divide `steps`."""
    chunk: int | None = None
    """Agents whose gradients are computed at once; a minibatch's are sums over chunks. None: 256, which fit a core's
    cache, on a CPU, and 65536 elsewhere."""
    gamma: float = 0.95
    """Discount per control step."""
    gae_lambda: float = 0.9
    """Of generalised advantage estimation (Schulman et al. 2016)."""
    clip: float = 0.2
    """Largest change of an action's probability ratio that is rewarded."""
    learning_rate: float = 4e-4
    """Of Adam."""
    max_grad_norm: float = 0.5
    """Largest global norm of a gradient; the value's readout has a norm of its own."""
    value_weight: float = 0.5
    """Weight of the value's error, which is measured in the variance of the returns."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus."""
    imitation_weight: float = 0.0
    """Weight of the squared distance from the first policy's actions, in units of the acceleration limit."""
    initial_std: float = 0.2
    """Exploration at the start: standard deviation of each action in units of the acceleration limit."""
    target_kl: float = 0.03
    """An update ends early when the policy has moved this far from the one that acted."""
    freeze: tuple[str, ...] = ()
    """Patterns over the paths of weights that stay as they are (`MODES`; * stands for any text)."""
    checkpoint_seconds: float = 60.0
    """Longest time between checkpoints [s]."""

    def __post_init__(self) -> None:
        for field in ("scenes", "steps", "iterations", "epochs", "minibatches"):
            if getattr(self, field) < 1:
                raise SpecError(field, getattr(self, field), "at least 1")
        if self.chunk is not None and self.chunk < 1:
            raise SpecError("chunk", self.chunk, "at least 1, or None")
        if self.steps % self.minibatches:
            raise SpecError("minibatches", self.minibatches, f"a divisor of steps = {self.steps}")
        for field in ("warmup", "terminations"):
            if (getattr(self, field) or 0) < 0:
                raise SpecError(field, getattr(self, field), "at least 0")
        for field in ("gamma", "gae_lambda"):
            if not 0 <= getattr(self, field) <= 1:
                raise SpecError(field, getattr(self, field), "from 0 to 1")
        for field in ("clip", "learning_rate", "max_grad_norm", "initial_std", "target_kl"):
            if not 0 < getattr(self, field) < math.inf:
                raise SpecError(field, getattr(self, field), "a finite number above 0")
        for field in ("value_weight", "entropy_weight", "imitation_weight"):
            if not 0 <= getattr(self, field) < math.inf:
                raise SpecError(field, getattr(self, field), "a finite number of at least 0")
