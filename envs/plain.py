"""Frozen configurations <-> plain JSON values, exactly: infinity is the string "inf", tuples are lists."""

import dataclasses
from typing import Any


def plain(config: Any) -> dict[str, Any]:
    """A frozen dataclass as plain JSON values."""
    return _walk(dataclasses.asdict(config), lambda x: "inf" if x == float("inf") else x)


def from_plain[T](kind: type[T], values: dict[str, Any]) -> T:
    """The `kind` that `plain` wrote; entries that it does not have are left out.

    Raises KeyError for a missing entry, and what `kind` raises for bad values.
    """
    own: Any = kind
    values = {field.name: values[field.name] for field in dataclasses.fields(own)}
    return kind(**{key: _restored(value) for key, value in values.items()})


def _restored(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(value)
    return float("inf") if value == "inf" else value


def _walk(tree: Any, leaf: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _walk(item, leaf) for key, item in tree.items()}
    if isinstance(tree, list | tuple):
        return [_walk(item, leaf) for item in tree]
    return leaf(tree)
