"""`swarmnet COMMAND`: parses with the standard-library configurations, and only then imports what the command needs."""

import importlib
import inspect
import logging
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from swarm_mjcf.errors import SwarmError
from swarmnet.config import (
    RL,
    Bench,
    Command,
    Demo,
    Doctor,
    Evaluate,
    Export,
    Import,
    Learn,
    Merge,
    Probe,
    Render,
    Report,
    Reproduce,
    Schedule,
    Simulate,
    Train,
)
from swarmnet.config_repair import Certify, Repair

_MODULES: dict[type, str] = {
    Simulate: "swarmnet.commands.simulate",
    Merge: "swarmnet.commands.merge",
    Train: "swarmnet.commands.train",
    Schedule: "swarmnet.commands.schedule",
    RL: "swarmnet.commands.rl",
    Repair: "swarmnet.commands.repair",
    Certify: "swarmnet.commands.certify",
    Evaluate: "swarmnet.commands.evaluate",
    Learn: "swarmnet.commands.learn",
    Probe: "swarmnet.commands.probe",
    Render: "swarmnet.commands.render",
    Demo: "swarmnet.commands.demo",
    Report: "swarmnet.commands.report",
    Doctor: "swarmnet.commands.doctor",
    Bench: "swarmnet.commands.bench",
    Import: "swarmnet.commands.import_",
    Export: "swarmnet.commands.export",
    Reproduce: "swarmnet.commands.reproduce",
}
"""Each has a function `run(config) -> int`, the exit code."""


# Positional arguments that may be left out; configurations are standard library only and cannot say so themselves.
Evaluate.__annotations__["run"] = tyro.conf.Positional[Evaluate.__annotations__["run"]]
Reproduce.__annotations__["name"] = tyro.conf.Positional[Reproduce.__annotations__["name"]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command. Exit codes: 0 done, 1 a check failed, 2 bad input or no way to write, 130 interrupted."""
    try:
        config = parse(sys.argv[1:] if arguments is None else arguments)
        _prepare()
        return importlib.import_module(_MODULES[type(config)]).run(config)
    except SwarmError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(f"{error.filename or ''}: {error.strerror or error}".lstrip(": "))
    except (RuntimeError, ValueError) as error:
        # What an engine raises inside a compiled function reaches us as text at the end of one of JAX's errors.
        _, raised, message = str(error).rpartition("EngineError: ")
        if not raised:
            raise
        return _fail(message)
    except KeyboardInterrupt:
        print("\nswarmnet: interrupted; the same command goes on from what is saved", file=sys.stderr)
        return 130


def parse(arguments: Sequence[str]) -> Command:
    """The configuration that the arguments describe; prints help or an error and exits otherwise."""
    overview = not arguments or arguments[0] in ("-h", "--help")
    kinds = tuple(
        Annotated[kind, tyro.conf.subcommand(kind.__name__.lower(), description=_help(kind, only_first=overview))]
        for kind in _MODULES
    )
    commands: Any = Union[kinds]  # noqa: UP007  (built from a tuple)
    return tyro.cli(
        commands,
        prog="swarmnet",
        description="Simulate swarms in MuJoCo, learn their law with a graph network, judge it by contacts.\n\n"
        "Start with:  swarmnet demo        Then:  swarmnet COMMAND --help",
        args=list(arguments),
        config=(tyro.conf.PositionalRequiredArgs,),
    )


def _help(kind: type, *, only_first: bool) -> str:
    text = inspect.cleandoc(kind.__doc__ or "")
    return text.split("\n\n")[0] if only_first else text


def _prepare() -> None:
    """Environment that libraries read when they are first imported."""
    os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")


def _fail(message: str) -> int:
    print(f"swarmnet: {message}", file=sys.stderr)
    return 2
