"""Public names of a package, loaded on first use: importing a package stays cheap, and so does every `--help`."""

import importlib
from collections.abc import Callable
from typing import Any


def lazy(package: str, modules: dict[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` for a package whose public `name` lies in `package.modules[name]`."""
    public = sorted(modules)

    def get(name: str) -> Any:
        if name in modules:
            return getattr(importlib.import_module(f"{package}.{modules[name]}"), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}; it has {', '.join(public)}")

    return get, lambda: public, public
