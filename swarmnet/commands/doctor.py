"""`swarmnet doctor`."""

import importlib.metadata
import os
import platform
import shutil
import sys

import jax

from envs.engines import available
from swarm_mjcf.render import check_gl
from swarmnet.config import Doctor
from swarmnet.engine_check import SUBSTEPS, check_engines
from swarmnet.progress import progress
from swarmnet.results import Results, Row, hardware, write_results

PACKAGES = (
    "mujoco", "mujoco-mjx", "dm_control", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "h5py",
    "mediapy", "imageio-ffmpeg", "tyro", "swarmnet-mujoco",
)  # fmt: skip


def run(config: Doctor) -> int:
    """Prints what is here; returns 1 when something is wrong."""
    problems = []
    print(f"python {platform.python_version()}  {sys.executable}")
    for name in PACKAGES:
        try:
            print(f"  {name:18} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            print(f"  {name:18} -")
            problems.append((f"{name} is not installed", "make setup"))
    problems += _versions()
    machine = hardware()
    print(f"cpu {machine['cpu']}, {machine['cores']} cores, {machine['memory_gib']} GiB")
    print(f"jax devices: {', '.join(machine['devices'])} (backend {jax.default_backend()})")
    gl = check_gl()
    print(f"GL: {gl.backend}, {gl.renderer or 'none'}" + (" (software)" if gl.software else ""))
    if gl.problem:
        problems.append((gl.problem, gl.fix or ""))
    problems += _ffmpeg()
    free = shutil.disk_usage(os.getcwd()).free / 2**30
    print(f"disk: {free:.1f} GiB free here")
    if free < 2:
        problems.append(
            (f"only {free:.1f} GiB free in this folder", "make room or work elsewhere: runs take up to 1 GiB")
        )
    if config.engines:
        problems += _engines(config)
    for problem, fix in problems:
        print(f"PROBLEM {problem}\n    fix: {fix}")
    if not problems:
        print("no problems found")
    return 1 if problems else 0


def _versions() -> list[tuple[str, str]]:
    version = importlib.metadata.version
    found = []
    if int(version("mujoco").split(".")[0]) >= 4:
        found.append(
            ("mujoco 4 does not work with dm_control, and has no mjx", "pip install 'mujoco<4' 'mujoco-mjx<4'")
        )
    if version("jax") in ("0.10.2", "0.11.1"):
        found.append((f"jax {version('jax')} gives wrong numbers under jit on CPU", "pip install 'jax>=0.12'"))
    if version("mujoco") != version("mujoco-mjx"):
        found.append(("mujoco and mujoco-mjx have different versions", "install the same version of both"))
    return found


def _ffmpeg() -> list[tuple[str, str]]:
    import imageio_ffmpeg

    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        return [("no ffmpeg: videos become gif", "pip install imageio-ffmpeg, or install the package ffmpeg")]
    return []


def _engines(config: Doctor) -> list[tuple[str, str]]:
    with progress("check engines") as update:
        verdicts, comparisons = check_engines(available(), config.scenes, progress=update)
    rows, problems = [], []
    for name, v in verdicts.items():
        print(
            f"engine {name}: {v.scenes} scenes ({v.touching_scenes / v.scenes:.0%} touching), {v.flags} contact flags, "
            f"{v.on} on, {v.wrong} wrong, {v.borderline} borderline; {v.counts} counts of {SUBSTEPS} substeps, "
            f"{v.wrong_counts} wrong, {v.borderline_counts} borderline"
        )
        for column in vars(v):
            rows.append(Row(name, column, getattr(v, column)))
        if v.wrong:
            problems.append(
                (f"engine {name} has {v.wrong} wrong contact flags", "use another engine; report the device")
            )
        if v.wrong_counts:
            problems.append(
                (f"engine {name} has {v.wrong_counts} wrong contact counts", "take 1 substep; report the device")
            )
    for (one, other), c in comparisons.items():
        print(
            f"engines {one} and {other}: {c.flags_apart} flags apart, positions at most {c.position_apart:.2g} m apart"
        )
        rows += [
            Row(f"{one} - {other}", "flags_apart", c.flags_apart),
            Row(f"{one} - {other}", "position_apart", c.position_apart, unit="m"),
        ]
        if c.flags_apart:
            problems.append(
                (f"engines {one} and {other} disagree on {c.flags_apart} flags", "see the wrong flags above")
            )
    if config.json:
        write_results(config.json, Results(name="doctor-engines", rows=rows, dt=0.02, seeds=[0]))
    return problems
