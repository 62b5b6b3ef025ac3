"""Whether data are like those a model was trained on: one line where they are not, never an error."""

import numpy as np

from envs.trajectories import Trajectories
from gnn.ranges import QUANTITIES, Figures, samples_of

OUTSIDE = 0.1
"""Share outside the training data's 1% to 99% that is worth a warning; data of the same kind have 0.02."""
_ROUNDING = 1e-3
_WORDS = {"agents": "agents at a time", "speed": "speed", "spacing": "distance to the nearest other"}


def out_of_range(seen: Figures | None, given: Trajectories) -> str | None:
    """What is outside the range that a model saw, in one line; None where nothing is or nobody wrote down what it saw.

    Args:
      seen: `gnn.ranges.figures_of` the training data, as a model knows it (`Model.seen`).
      given: what the model is used on.
    """
    parts = []
    for name, values in samples_of(given).items() if seen else ():
        if not len(values) or name not in seen:  # pyright: ignore[reportOperatorIssue]
            continue
        low, _, high, _ = seen[name]  # pyright: ignore[reportOptionalSubscript]
        outside = float(np.mean((values < low - _ROUNDING * abs(low)) | (values > high + _ROUNDING * abs(high))))
        if outside > OUTSIDE:
            unit = f" {QUANTITIES[name]}".rstrip()
            here = _span(*np.quantile(values, (0.01, 0.99)))
            parts.append(f"{_WORDS[name]} {here}{unit}, trained on {_span(low, high)}{unit} ({outside:.0%} outside)")
    return "out of the range of the training data: " + "; ".join(parts) if parts else None


def _span(low: float, high: float) -> str:
    return f"{low:.3g}" if f"{low:.3g}" == f"{high:.3g}" else f"{low:.3g} to {high:.3g}"
