"""The demo end to end, very small: everything it promises is there, a second call keeps it, a mix-up is refused."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from learning import quick_training

import swarmnet.commands.demo
from envs.config import SimulateConfig
from gnn.config import TrainConfig
from gnn.metrics import read_metrics
from swarmnet.cli import main
from swarmnet.commands.demo import _judged

DEMO = (
    "demo", "--name", "small", "--scenes", "12", "--test-scenes", "4", "--scale", "0.2", "--videos", "1",
    "--model", "thesis-ch5", "--engine", "native",
)  # fmt: skip


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Iterator[Path]:
    """The run folder of a demo that has run once; the tests below run beside it."""
    curriculum = {"horizons": (1, 2), "stage_steps": (50, 50), "chunk": 10, "batch": 16}
    with pytest.MonkeyPatch.context() as patch, quick_training():
        patch.chdir(tmp_path_factory.mktemp("demo"))
        patch.setattr(swarmnet.commands.demo, "TrainConfig", partial(TrainConfig, **curriculum))
        assert main(DEMO) == 0
        yield Path("runs/small").absolute()


def stamps(folder: Path) -> dict[str, int]:
    kept = [folder / "data.h5", folder / "evaluation.json", *(folder / "checkpoints").rglob("*")]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in kept if path.is_file()}


def test_everything_the_demo_promises_is_there(demo: Path):
    for name in ("data.h5", "evaluation.json", "config.json", "metrics.jsonl", "report.html", "rollouts/learned.h5"):
        assert (demo / name).stat().st_size > 0, name
    videos = [path for path in (demo / "videos").iterdir() if path.suffix in (".mp4", ".gif")]
    assert videos
    assert all(video.stat().st_size > 1000 for video in videos)
    assert read_metrics(demo / "metrics.jsonl")[-1]["step"] == 20
    judged = json.loads((demo / "evaluation.json").read_text())
    assert set(judged["prediction"]) == {"swarmnet thesis-ch5", "constant velocity", "persistence"}
    assert set(judged["collisions"]) == {"swarmnet thesis-ch5", "expert"}
    assert (judged["scenes"], judged["steps"], judged["dt"], judged["seed"]) == (4, 50, 0.3, 1_000_000)
    assert judged["prediction"]["persistence"]["published_mean"][0] == pytest.approx(1, rel=1e-4)
    assert not list(demo.rglob("*.partial*"))


def test_the_report_needs_nothing_but_itself(demo: Path):
    page = (demo / "report.html").read_text()
    assert "data:video/" in page or "data:image/gif" in page
    assert "data:image/" in page
    for outside in ('src="http', "src='http", 'href="http', "<script src"):
        assert outside not in page


def test_a_second_call_keeps_what_is_done_and_says_the_same(demo: Path, capsys):
    before = stamps(demo)
    assert len(before) > 4
    assert main(DEMO) == 0
    out = capsys.readouterr().out
    assert stamps(demo) == before
    assert "report.html  <- open this" in out
    assert "4 unseen scenes, 50 control steps of 0.3 s" in out
    for words in ("final goal distance", "steps with a contact", "normalized prediction error"):
        assert words in out


@pytest.mark.parametrize("wrong", [("--scenes", "1"), ("--test-scenes", "0"), ("--scale", "nan"), ("--model", "kipf")])
def test_bad_input_leaves_no_folder(wrong: tuple[str, str], tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main((*DEMO, *wrong)) == 2
    assert "swarmnet: " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_what_another_command_judged_is_not_taken_for_the_demo_s(demo: Path, tmp_path: Path):
    judged, unseen = json.loads((demo / "evaluation.json").read_text()), SimulateConfig(scenes=4, seed=1_000_000)
    name, path = "swarmnet thesis-ch5", tmp_path / "evaluation.json"
    assert not _judged(path, unseen, name)
    other = {"swarmnet thesis-ch5, 3 nearest": 0, "expert": 0}
    changes = ({"seed": 7}, {"scenes": 5}, {"steps": 9}, {"collisions": other}, {"asked": {"actuation_noise": 1.0}})
    for change, own in (({}, True), *((change, False) for change in changes)):
        path.write_text(json.dumps(judged | change))
        assert _judged(path, unseen, name) == own, change


@pytest.mark.parametrize("change", [("--seed", "1"), ("--scenes", "13"), ("--model", "best"), ("--scale", "0.5")])
def test_other_settings_under_the_same_name_are_refused(demo: Path, change: tuple[str, str], capsys):
    before = stamps(demo)
    assert main((*DEMO, *change)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "holds a demo of other settings" in line
    assert change[0].removeprefix("--") in line
    assert "choose another --name" in line
    assert stamps(demo) == before
