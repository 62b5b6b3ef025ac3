"""Frozen configurations <-> plain JSON values, exactly: infinity is the string "inf", tuples are lists."""

import dataclasses
from typing import Any


def plain(config: Any) -> dict[str, Any]:
    """A frozen dataclass as plain JSON values."""
    return _plain_values(dataclasses.asdict(config))


def from_plain[T](kind: type[T], values: dict[str, Any]) -> T:
    """The `kind` that `plain` wrote; entries that it does not have are left out.

    A missing entry is its default: what was written before the field existed. Raises KeyError for one without a
    default, and what `kind` raises for bad values.
    """
    own: Any = kind
    needed = (f.name for f in dataclasses.fields(own) if f.default is f.default_factory is dataclasses.MISSING)
    values = {f.name: values[f.name] for f in dataclasses.fields(own) if f.name in values} | {
        name: values[name] for name in needed
    }
    return kind(**{key: _restored(value) for key, value in values.items()})


def completed(kind: type, values: dict[str, Any]) -> dict[str, Any]:
    """What `plain` wrote, with the defaults of the fields that `kind` has got since."""
    new = {f.name: f.default for f in dataclasses.fields(kind) if f.name not in values}
    return _plain_values({k: v for k, v in new.items() if v is not dataclasses.MISSING}) | values


def _restored(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(value)
    return float("inf") if value == "inf" else value


def _plain_values(values: dict[str, Any]) -> dict[str, Any]:
    return _walk(values, lambda x: "inf" if x == float("inf") else x)


def _walk(tree: Any, leaf: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _walk(item, leaf) for key, item in tree.items()}
    if isinstance(tree, list | tuple):
        return [_walk(item, leaf) for item in tree]
    return leaf(tree)
