"""The command line: help without heavy imports, one clear message for every mistake, results in one format."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from learning import environment, published, quick_training

from envs.storage import save
from swarm_mjcf.errors import SwarmError
from swarmnet.cli import main
from swarmnet.results import Results, Row, write_results

COMMANDS = (
    "simulate", "merge", "import", "export", "train", "schedule", "rl", "repair", "certify", "evaluate", "learn",
    "probe", "render", "demo", "report", "doctor", "bench", "reproduce",
)  # fmt: skip
HEAVY = ("jax", "mujoco", "flax", "orbax", "h5py", "matplotlib", "optax", "dm_control", "numpy")
PROBE = f"""
import sys
from swarmnet.cli import main
try:
    main(sys.argv[1:])
    code = None
except SystemExit as error:
    code = error.code
print("HEAVY", code, *(name for name in {HEAVY!r} if name in sys.modules))
"""


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_training():
        yield


def in_process(*arguments: str) -> subprocess.CompletedProcess:
    """`swarmnet ARGUMENTS` in a process of its own."""
    command = [sys.executable, "-m", "swarmnet", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment())


def fails(capsys, *arguments: str) -> str:
    """Runs a command that must exit with 2 and one line on stderr; returns the line."""
    assert main(arguments) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("swarmnet: ")
    assert "Traceback" not in captured.err + captured.out
    return line


# --- help ---


@pytest.mark.parametrize("command", [(), *((name,) for name in COMMANDS)], ids=lambda c: "".join(c) or "top")
def test_help_is_complete_and_imports_nothing_heavy(command: tuple[str, ...]):
    found = subprocess.run(
        [sys.executable, "-c", PROBE, *command, "--help"], capture_output=True, text=True, env=environment()
    )
    assert found.returncode == 0, found.stderr
    assert not found.stderr
    text, last = found.stdout.rsplit("HEAVY", 1)
    assert last.split() == ["0"], f"exit code, then modules that help must not import: {last}"
    if command:
        assert f"  swarmnet {command[0]} " in text.split("Example:")[1]
    else:
        assert "swarmnet demo" in text
        assert all(name in text for name in COMMANDS)


def test_no_command_explains_itself():
    found = in_process()
    assert found.returncode == 2
    assert "simulate" in found.stdout + found.stderr
    assert "Traceback" not in found.stderr


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("fly",), "fly"),
        (("simulate", "--scened", "3"), "--scened"),
        (("simulate", "--scenes", "many"), "many"),
        (("render",), "Trajectories to show"),
        (("bench", "weather"), "weather"),
        (("render", "x.h5", "--camera", "inside"), "inside"),
        (("repair", "x", "--method", "magic"), "magic"),
        (("repair", "x", "--descent.stepz", "3"), "--descent.stepz"),
        (("certify", "x", "--goal", "1"), "--goal"),
        (("evaluate", "x", "--filter", "wall"), "wall"),
    ],
)
def test_a_wrong_word_is_named_and_exits_with_2(arguments: tuple[str, ...], named: str, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    captured = capsys.readouterr()
    assert named.lower() in (captured.err + captured.out).lower()
    assert "Traceback" not in captured.err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("simulate", "--scenes", "0"), "scenes: 0 was given"),
        (("simulate", "--preset", "moon"), "preset: 'moon' was given"),
        (
            ("train", "x.h5", "--model", "gat"),
            "one of thesis-ch3, thesis-ch3-blind, thesis-ch5, thesis-ch5-small, best",
        ),
        (("train", "x.h5", "--stage-steps", "5", "5", "5", "5"), "multiples of chunk"),
        (("train", "x.h5", "--chunk", "0"), "chunk: 0 was given"),
        (("repair", "x", "--rounds", "-1"), "rounds: -1 was given"),
        (("repair", "x", "--scenes", "0"), "scenes: 0 was given"),
        (("repair", "x", "--test-scenes", "-1"), "test_scenes: -1 was given"),
        (("repair", "x", "--constraint.name", "wall"), "one of barrier, disc, polygon, diamond, roll-out"),
        (("repair", "x", "--constraint.margin", "nan"), "margin: nan was given"),
        (("repair", "x", "--descent.steps", "0"), "steps: 0 was given"),
        (("repair", "x", "--reserve-share", "1.5"), "reserve_share: 1.5 was given"),
        (("certify", "x", "--distance", "0"), "distance: 0.0 was given"),
        (("certify", "x", "--share", "2"), "share: 2.0 was given"),
        (("certify", "x", "--goal", "nan", "0"), "goal: (nan, 0.0) was given"),
        (("certify", "x", "--neighbour-half", "-1", "0"), "neighbour_half: (-1.0, 0.0) was given"),
        (("certify", "x", "--cells", "-1"), "cells: -1 was given"),
        (("certify", "x", "--time-limit", "nan"), "time_limit: nan was given"),
    ],
)
def test_a_value_that_its_own_configuration_refuses_exits_with_2(arguments, named: str, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    captured = capsys.readouterr()
    text = " ".join((captured.err + captured.out).replace("│", " ").split())
    assert named in text
    assert "Traceback" not in text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("train", "x.h5", "--validation", "1.5"), "a share between 0 and 1"),
        (("train", "no/such.h5"), "no/such.h5: does not exist"),
        (("evaluate", "no/run"), "no/run/checkpoints: no such checkpoint folder"),
        (("render", "no/such.h5"), "no/such.h5"),
        (("report", "no/run"), "no/run"),
        (("repair", "no/run", "--run", "r"), "no/run/checkpoints: no such checkpoint folder"),
        (("repair", "no/run", "--run", "no/../no/run"), "another folder than the one of the model"),
        (("certify", "no/run"), "no/run/checkpoints: no such checkpoint folder"),
        (("evaluate", "--policy", "expert", "--filter-margin", "1"), "filter_margin: 1.0 was given"),
        (("evaluate", "--policy", "expert", "--filter", "disc", "--filter-margin", "-1"), "margin: -1.0 was given"),
        (("evaluate", "--policy", "expert", "--filter", "barrier", "--filter-share", "0"), "share: 0.0 was given"),
        (("evaluate", "--policy", "expert", "--data", "x.h5", "--filter", "disc"), "filter: 'disc' was given"),
        (("demo", "--model", "thesis-ch3"), "thesis-ch5 or best"),
        (("demo", "--scale", "0"), "scale"),
    ],
)
def test_a_value_that_makes_no_sense_is_one_line(arguments: tuple[str, ...], named: str, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = fails(capsys, *arguments)
    assert named in line
    assert not list(tmp_path.iterdir())


def test_an_error_of_ours_is_one_line_on_stderr_in_a_process():
    found = in_process("train", "/no/such.h5")
    assert found.returncode == 2
    assert found.stderr == "swarmnet: /no/such.h5: does not exist\n"
    assert not found.stdout


# --- the commands ---


def test_simulate_train_evaluate_in_a_row(tmp_path: Path, monkeypatch, capsys):
    """The commands by hand, one after the other, small; a second call of each says that it is done."""
    monkeypatch.chdir(tmp_path)
    simulate = ("simulate", "--scenes", "6", "--steps", "12", "--num-agents", "3", "--engine", "native")
    simulate += ("--out", "d.h5")
    assert main(simulate) == 0
    assert "6 scenes of 13 rows, 5 nodes, dt 0.3 s" in capsys.readouterr().out
    written = (tmp_path / "d.h5").read_bytes()
    assert main(simulate) == 0
    assert "was there already" in capsys.readouterr().out
    assert (tmp_path / "d.h5").read_bytes() == written
    assert "other settings" in fails(capsys, *simulate, "--seed", "1")
    train = ("train", "d.h5", "--run", "r", "--model", "thesis-ch5", "--horizons", "1", "--stage-steps", "4")
    train += ("--chunk", "2", "--batch", "4", "--learning-rate", "0.0001")
    assert main(train) == 0
    assert "r: thesis-ch5 trained for 4 steps on 5 scenes" in capsys.readouterr().out
    assert "scenes that the model learned in" in fails(capsys, "evaluate", "r", "--seed", "0", "--scenes", "2")
    assert "train differ" in fails(capsys, *train, "--seed", "5")
    faster = ("--num-agents", "2", "--preset", "published", "--dt", "0.1", "--out", "p.h5")
    assert main(("simulate", "--scenes", "6", "--steps", "12", *faster)) == 0
    capsys.readouterr()
    assert "rows 0.1 s apart" in fails(capsys, "probe", "r", "--data", "p.h5")
    assert main(("evaluate", "r", "--scenes", "3", "--steps", "12", "--videos", "0", "--json", "e.json")) == 0
    out = capsys.readouterr().out
    for words in ("swarmnet thesis-ch5", "constant velocity", "persistence", "3 unseen scenes", "dt 0.3 s", "report:"):
        assert words in out
    document = json.loads((tmp_path / "e.json").read_text())
    check_format(document)
    cells = {(row["row"], row["column"]): row["value"] for row in document["rows"]}
    assert cells["persistence", "published_mean 1 steps"] == pytest.approx(1, rel=1e-4)
    assert ("swarmnet thesis-ch5", "published_median 10 steps") in cells
    assert document["dt"] == 0.3
    assert document["seeds"] == [1_000_000]
    assert (tmp_path / "r" / "rollouts" / "learned.h5").exists()


def check_format(document: dict) -> None:
    assert set(document) == {
        "name", "command", "commit", "date", "profile", "hardware", "versions", "dt", "seeds", "rows",
    }  # fmt: skip
    assert document["rows"]
    for row in document["rows"]:
        assert set(row) == {"row", "column", "value", "std", "reference", "unit"}
    assert set(document["versions"]) >= {"python", "mujoco", "jax", "flax"}
    assert set(document["hardware"]) == {"cpu", "cores", "memory_gib", "devices"}


def test_results_have_their_format_and_no_number_that_json_lacks(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/swarmnet", "bench", "engines"])
    rows = [Row("a", "b", float("nan")), Row("a", "c", 2.0, std=float("inf"), reference=3.0, unit="m")]
    write_results(tmp_path / "deep" / "r.json", Results(name="n", rows=rows, dt=None, seeds=[1]))
    text = (tmp_path / "deep" / "r.json").read_text()
    document = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    check_format(document)
    assert document["command"] == "swarmnet bench engines"
    assert document["rows"][0] == {
        "row": "a", "column": "b", "value": None, "std": None, "reference": None, "unit": "",
    }  # fmt: skip
    assert document["rows"][1]["std"] is None
    assert document["rows"][1]["value"] == 2.0
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["r.json"]


def test_results_that_cannot_be_written_say_so():
    with pytest.raises(SwarmError, match=r"/proc/nowhere/r\.json: cannot be written"):
        write_results("/proc/nowhere/r.json", Results(name="n", rows=[], dt=None, seeds=[]))


def test_doctor_prints_versions_and_checks_the_engines(tmp_path: Path, capsys):
    code = main(("doctor", "--engines", "--scenes", "2000", "--json", str(tmp_path / "d.json")))
    out = capsys.readouterr().out
    assert code == (1 if "PROBLEM" in out else 0)
    for words in ("python 3", "mujoco ", "jax ", "orbax-checkpoint", "cpu ", "jax devices:", "GL: ", "GiB free"):
        assert words in out
    document = json.loads((tmp_path / "d.json").read_text())
    check_format(document)
    cells = {(row["row"], row["column"]): row["value"] for row in document["rows"]}
    for engine in ("native", "mjx"):
        assert f"engine {engine}: 2000 scenes" in out
        assert cells[engine, "scenes"] == 2000
        assert cells[engine, "wrong"] == 0
        assert cells[engine, "touching_scenes"] >= 2000 / 5
    assert cells["native - mjx", "flags_apart"] == 0


def test_doctor_exits_with_1_and_a_fix_when_something_is_wrong(monkeypatch, capsys):
    import swarmnet.commands.doctor as doctor

    assert main(("doctor",)) == (1 if "PROBLEM" in capsys.readouterr().out else 0)
    monkeypatch.setattr(doctor, "_ffmpeg", lambda: [("no ffmpeg", "install it")])
    assert main(("doctor",)) == 1
    out = capsys.readouterr().out
    assert "PROBLEM no ffmpeg\n    fix: install it" in out
    assert "no problems found" not in out


def test_an_engine_that_gives_up_inside_a_compiled_function_is_told_in_one_message(tmp_path: Path, monkeypatch, capsys):
    from envs.engines.native import EngineError, NativeEngine

    def gives_up(*_):
        raise EngineError("native: out of room")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(NativeEngine, "_check_warnings", gives_up)
    told = fails(capsys, "simulate", "--preset", "clear", "--scenes", "2", "--steps", "2", "--out", "d.h5")
    assert told == "swarmnet: native: out of room"
    assert not (tmp_path / "d.h5").exists()


def test_an_error_of_our_own_is_no_bad_input(monkeypatch):
    import swarmnet.commands.doctor as doctor

    def broken(_):
        raise RuntimeError("a mistake in the program")

    monkeypatch.setattr(doctor, "run", broken)
    with pytest.raises(RuntimeError, match="a mistake"):
        main(("doctor",))


def test_an_interruption_says_how_to_go_on(tmp_path: Path, monkeypatch, capsys):
    import swarmnet.commands.train as command

    save(tmp_path / "d.h5", published())

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "train", interrupted)
    assert main(("train", str(tmp_path / "d.h5"), "--run", str(tmp_path / "r"))) == 130
    assert "the same command goes on" in capsys.readouterr().err
