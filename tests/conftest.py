"""Settings that must stand before any test module imports JAX, and Hypothesis's profile."""

import contextlib
import gc
import importlib
import os
import sys
from pathlib import Path

# The CPU gives the same numbers everywhere, at full precision; a machine with an accelerator sets JAX_PLATFORMS itself.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")
# Compiling is two thirds of the suite's time, and tests compile much and run little; 0 tests what users run, slowly.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

import jax
import pytest
from hypothesis import settings

# jaxtyping's hook has whatever is imported on the way of an instrumented module compiled from source, 2000 modules of
# libraries in each worker: what is here before has its bytecode.
for library in (
    "beartype.door", "cvxpy", "flax.linen", "h5py", "jax.experimental.shard_map", "matplotlib.backends.backend_agg",
    "matplotlib.figure", "optax", "orbax.checkpoint", "PIL.Image", "pyarrow.parquet", "pyscipopt",
    "rich.progress", "scipy.io", "scipy.optimize", "scipy.spatial", "scipy.stats", "tensorboardX", "tyro",
):  # fmt: skip
    with contextlib.suppress(ImportError):  # those are for the tests that need them to tell of
        importlib.import_module(library)

# Tests share `helpers.py`; with import mode importlib their folder is not on the path by itself.
sys.path.insert(0, str(Path(__file__).parent))

# The first example of a test compiles, so no single example has a deadline. CI tries the same examples each time.
settings.register_profile("swarmnet", deadline=None, derandomize=os.environ.get("CI") == "true")
settings.load_profile("swarmnet")


def pytest_collection_finish() -> None:
    """What imports and collection made stays to the end: the garbage collector need not look at it again and again."""
    gc.collect()
    gc.freeze()


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Between modules, lets go of compiled programs before they fill a process: every one takes a few of the 65,530
    mappings that Linux gives it, and XLA does not survive their end."""
    mappings = Path("/proc/self/maps")
    if nextitem is not None and nextitem.path != item.path and mappings.exists():
        with mappings.open() as lines:
            if sum(1 for _ in lines) > 30_000:
                jax.clear_caches()
