"""`@record`: a frozen dataclass that is a JAX pytree, its shapes checked where code builds it."""

import dataclasses
from collections.abc import Iterable
from typing import Any, dataclass_transform

import jax
import numpy as np

Array = jax.Array | np.ndarray
"""What a field may hold: JAX inside `jit`, NumPy in callbacks and files."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
def record[T](cls: type[T]) -> type[T]:
    """Makes `cls` a frozen, keyword-only dataclass and a pytree of its fields.

    JAX rebuilds pytrees with stacked or placeholder leaves; those skip `__init__`, so that shape checks (jaxtyping)
    hold for every record that code builds and never for one on its way through `scan` or `vmap`.
    """
    made: Any = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
    names = tuple(field.name for field in dataclasses.fields(made))

    def flatten(item: Any) -> tuple[tuple[tuple[Any, Any], ...], None]:
        return tuple((jax.tree_util.GetAttrKey(name), getattr(item, name)) for name in names), None

    def unflatten(_: None, leaves: Iterable[Any]) -> T:
        item = object.__new__(made)
        for name, leaf in zip(names, leaves, strict=True):
            object.__setattr__(item, name, leaf)
        return item

    jax.tree_util.register_pytree_with_keys(made, flatten, unflatten)
    return made
