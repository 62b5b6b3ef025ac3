"""Physics engines behind one protocol. Names: `native` (C, threads), `mjx` (XLA), `mjx-warp` (CUDA; an extra)."""

import importlib.util
from typing import TYPE_CHECKING

from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec

if TYPE_CHECKING:
    from envs.engines.engine import Engine

ENGINES = ("native", "mjx")
OPTIONAL_ENGINES = {"mjx-warp": "warp"}
"""Engines that an extra installs, and the module that it brings: `.venv/bin/pip install 'mujoco-mjx[warp]<4'`."""


def available() -> tuple[str, ...]:
    """Engines that this machine has: `ENGINES`, and the optional ones whose extra is installed."""
    return ENGINES + tuple(name for name, module in OPTIONAL_ENGINES.items() if importlib.util.find_spec(module))


def make_engine(spec: SceneSpec, name: str = "auto", *, threads: int = 0) -> "Engine":
    """An engine by name; `auto` takes `mjx` where JAX has a GPU or TPU and `native` elsewhere.

    `threads` is for the native engine; 0 takes every CPU. Raises SpecError for a name that does not exist, EngineError
    for an engine that is not installed.
    """
    if name == "auto":
        import jax

        name = "native" if jax.default_backend() == "cpu" else "mjx"
    if name == "native":
        from envs.engines.native import NativeEngine

        return NativeEngine(spec, threads=threads)
    if name == "mjx":
        from envs.engines.mjx import MjxEngine

        return MjxEngine(spec)
    if name == "mjx-warp":
        from envs.engines.mjx_warp import MjxWarpEngine

        return MjxWarpEngine(spec)
    raise SpecError("engine", name, "one of auto, " + ", ".join((*ENGINES, *OPTIONAL_ENGINES)))
