"""Parts of a network that stay as they are, named by patterns over the paths of its weights."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

import jax
import optax

from swarm_mjcf.errors import SpecError

Mask = Any
"""A tree of bool in the structure of the weights: True for a leaf that stays as it is."""


def paths_of(params: Any) -> list[str]:
    """Paths of the leaves in their order, such as `edge/goal/layer0/kernel`."""
    return [jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in jax.tree.leaves_with_path(params)]


def frozen(params: Any, patterns: Sequence[str]) -> Mask:
    """Which leaves match one of the patterns (`edge/*`, `*/bias`; `*` stands for any text, slashes too).

    `params` may be weights or their shapes. Raises SpecError for a pattern that matches nothing, and where nothing is
    left to train.
    """
    paths = paths_of(params)
    for pattern in patterns:
        if not any(fnmatchcase(path, pattern) for path in paths):
            raise SpecError("freeze", pattern, "a pattern that matches some of " + ", ".join(paths))
    chosen = [any(fnmatchcase(path, pattern) for pattern in patterns) for path in paths]
    if all(chosen):
        raise SpecError("freeze", list(patterns), "patterns that leave something to train")
    return jax.tree.unflatten(jax.tree.structure(params), chosen)


def freeze(optimizer: optax.GradientTransformation, mask: Mask) -> optax.GradientTransformation:
    """The optimizer for the leaves that are free: it never sees the others, whose updates are exactly 0.

    So frozen leaves count in no clipped norm and suffer no weight decay, and they stay the same to the bit.
    """
    labels = jax.tree.map(lambda stays: "frozen" if stays else "free", mask)
    return optax.partition({"free": optimizer, "frozen": optax.set_to_zero()}, labels)


def free_leaves(tree: Any, mask: Mask) -> list:
    """Leaves of a tree in the structure of the weights that are not frozen."""
    return [leaf for leaf, stays in zip(jax.tree.leaves(tree), jax.tree.leaves(mask), strict=True) if not stays]
