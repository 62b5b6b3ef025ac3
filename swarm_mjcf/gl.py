"""Which OpenGL draws here: found out in a subprocess, because a broken driver may abort the process that asks.

Importing this module before `mujoco` also keeps `import mujoco` from failing: MuJoCo loads the library that MUJOCO_GL
names while it is imported, and a missing one ends every program, also those that never draw.
"""

import ctypes
import ctypes.util
import functools
import importlib
import json
import logging
import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

from swarm_mjcf.errors import SwarmError

log = logging.getLogger("swarm_mjcf")

_SYSTEM = platform.system()
_DEFAULT = {"Linux": "egl", "Darwin": "cgl"}.get(_SYSTEM, "glfw")
_OFF = ("disable", "disabled", "off", "false", "0")
_BACKENDS = {name: _DEFAULT for name in ("", "enable", "enabled", "on", "true", "1")}
_BACKENDS |= {"glfw": "glfw", "glx": "glfw", "wgl": "glfw", "egl": "egl", "osmesa": "osmesa", "cgl": "cgl"}
_LIBRARY = {"egl": "EGL", "osmesa": "OSMesa"}
_FIX = {
    "egl": "sudo apt-get install libegl1 libgl1 libgl1-mesa-dri  (Fedora: mesa-libEGL mesa-dri-drivers)",
    "osmesa": "sudo apt-get install libosmesa6, or unset MUJOCO_GL",
    "glfw": "unset MUJOCO_GL (headless drawing goes through EGL), or start a display",
    "cgl": "unset MUJOCO_GL",
}
_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader", "software", "lavapipe", "gdi generic")
_PROBE_SECONDS = 60.0


class RenderError(SwarmError):
    """MuJoCo cannot draw here; says why and what to install."""


@dataclass(frozen=True)
class GLReport:
    """What draws MuJoCo's pictures on this machine."""

    backend: str
    """How a context is made: egl, osmesa, glfw or cgl; empty when MUJOCO_GL names none."""
    renderer: str
    """The renderer's own name, for example `llvmpipe (LLVM 15.0.6, 256 bits)`; empty when there is none."""
    version: str
    """OpenGL's version string."""
    software: bool
    """Whether the processor draws instead of a graphics card."""
    problem: str | None = None
    """Why MuJoCo cannot draw, or None when it can."""
    fix: str | None = None
    """What to do about the problem, or about slow drawing."""

    def __str__(self) -> str:
        if self.problem:
            return f"no OpenGL ({self.backend or 'MUJOCO_GL'}): {self.problem}; to mend it: {self.fix}"
        return f"{self.renderer} through {self.backend}, OpenGL {self.version}{' (software)' if self.software else ''}"


def _prepare() -> str:
    """Settles MUJOCO_GL before MuJoCo is imported; returns what the user had asked for."""
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    backend = _BACKENDS.get(asked)
    if backend is None or (backend in _LIBRARY and not _loadable(_LIBRARY[backend])):
        # `import mujoco` would raise on this value; without a default it would try GLFW, which needs a display.
        os.environ["MUJOCO_GL"] = "disable"
    elif asked == "":
        os.environ["MUJOCO_GL"] = backend
    return asked


def _loadable(library: str) -> bool:
    try:
        ctypes.CDLL(ctypes.util.find_library(library) or f"lib{library}.so.1")
    except OSError:
        return False
    return True


_ASKED = _prepare()


def check_gl() -> GLReport:
    """Finds out who draws here; asks once per process (about a second), never raises."""
    return _check(_ASKED)


def new_context(width: int, height: int) -> Any:
    """An OpenGL context of MuJoCo's, made without MuJoCo's own choice at import; raises whatever the driver raises."""
    backend = _BACKENDS[_ASKED]
    return importlib.import_module(f"mujoco.{backend}").GLContext(width, height)


@functools.cache
def warn_if_slow() -> None:
    """Says once per process that the processor draws."""
    report = check_gl()
    if report.software:
        log.warning("videos are drawn in software by %s: slower than a graphics card, same pictures", report.renderer)


@functools.cache
def _check(asked: str) -> GLReport:
    if asked in _OFF:
        return GLReport("", "", "", False, f"MUJOCO_GL={asked} switches drawing off", "unset MUJOCO_GL")
    if asked not in _BACKENDS:
        allowed = "egl, osmesa, glfw or unset"
        return GLReport("", "", "", False, f"MUJOCO_GL={asked!r} is unknown", f"set MUJOCO_GL to {allowed}")
    backend = _BACKENDS[asked]
    if backend in _LIBRARY and not _loadable(_LIBRARY[backend]):
        return GLReport(backend, "", "", False, f"lib{_LIBRARY[backend]} is not installed", _FIX[backend])
    # The child imports what this process would import, and dies alone if the driver aborts.
    code = f"import sys; sys.path[:] = {sys.path!r}; from swarm_mjcf import gl; gl._probe()"
    environment = {**os.environ, "MUJOCO_GL": asked}
    try:
        child = subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PROBE_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return GLReport(backend, "", "", False, f"the driver hangs ({_PROBE_SECONDS:g} s)", _FIX[backend])
    except OSError as error:
        return GLReport(backend, "", "", False, f"the check could not be started: {error}", _FIX[backend])
    lines = child.stdout.strip().splitlines()
    if child.returncode or not lines:
        said = child.stderr.strip().splitlines() or [f"the check ended with status {child.returncode}"]
        return GLReport(backend, "", "", False, said[-1], _FIX[backend])
    renderer, version = json.loads(lines[-1])
    software = any(word in renderer.lower() for word in _SOFTWARE)
    return GLReport(backend, renderer, version, software, fix="a graphics card's driver" if software else None)


def _probe() -> None:
    """Runs in the child: draws with MuJoCo once and prints who did it."""
    import mujoco

    context = new_context(16, 16)
    context.make_current()
    from OpenGL import GL

    names = [(GL.glGetString(key) or b"").decode(errors="replace") for key in (GL.GL_RENDERER, GL.GL_VERSION)]
    mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100).free()
    context.free()
    print(json.dumps(names), flush=True)
