"""The report: the measured numbers, in one self-contained and well-formed page, whatever part of a run is there."""

import json
import shlex
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from test_figures import ROWS, estimate, rates, scenes

from envs.collisions import collision_report
from envs.plain import plain
from envs.storage import save
from gnn.checkpoint import Checkpoints
from repair.config import ConstraintConfig, LoopConfig
from swarm_mjcf.errors import SwarmError
from swarmnet.cli import parse
from swarmnet.config import Demo, Evaluate, Render, Report, Simulate, Train
from swarmnet.report import _repair_command, write_report
from swarmnet.report_commands import commands
from swarmnet.report_facts import gather

VOID = {"meta", "img", "br", "source"}
NASTY = "<script>alert('x')</script>&"
SIMULATE = {
    "preset": "clear", "scenes": 60, "steps": 5, "num_agents": 2, "num_obstacles": 1, "mixed": True, "seed": 3,
    "engine": "native", "threads": 0, "chunk": 1024,
}  # fmt: skip
TRAIN = {
    "model": "thesis-ch5", "seed": 4, "horizons": [1, 5], "stage_steps": [100, 200], "batch": 64,
    "learning_rate": 0.002, "clip_norm": 1.0, "noise": 0.1, "chunk": 100, "checkpoint_seconds": None,
}  # fmt: skip


class Page(HTMLParser):
    """Tags, attributes and text of a page; every tag must be closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def page_of(run: Path) -> Page:
    return Page(write_report(run).read_text())


def add_model(run: Path, *, preset: str = "thesis-ch5") -> None:
    run.mkdir(exist_ok=True)
    about = {
        "preset": preset,
        "train": TRAIN,
        "data": {"scenes": 50, "expert": "boids", "engine": "native", "simulate": SIMULATE, "versions": {"jax": "0"}},
        "model": {"window": 1},
    }
    checkpoints = Checkpoints(run / "checkpoints")
    checkpoints.save(200, {"step": np.zeros(())}, about)
    checkpoints.close()
    (run / "metrics.jsonl").write_text("".join(json.dumps(row | {"stage": int(row["stage"])}) + "\n" for row in ROWS))


def add_evaluation(run: Path, *, name: str = "swarmnet best", contacts: bool = True, **changes) -> None:
    run.mkdir(exist_ok=True)
    errors = {
        who: {
            "horizons": [1, 5],
            "published_mean": [0.0123 * k, 0.4567 * k],
            "published_median": [0.00321 * k, 0.111 * k],
            "agents_mean": [0.0456 * k, 0.9876 * k],
            "agents_median": [0.007 * k, 0.222 * k],
            "by_step": [0.1 * k, 0.2 * k],
            "windows": [432, 321],
        }
        for k, who in enumerate((name, "constant velocity", "persistence"), start=1)
    }
    extra = {"final_goal_distance": estimate(13.37, 12.1, 14.9, "m"), "deepest_penetration": estimate(0.0271, unit="m")}
    collisions = {"expert": rates(0.00125) | extra, name: rates(0.0375) | extra}
    document = {
        "prediction": errors, "collisions": collisions, "contacts": contacts, "dt": 0.5, "scenes": 77, "steps": 5,
        "seed": 99,
    }  # fmt: skip
    (run / "evaluation.json").write_text(json.dumps(document | changes))


def test_a_whole_run(tmp_path) -> None:
    run = tmp_path / "first run"
    add_model(run)
    add_evaluation(run)
    for name in ("expert", "learned", "sweep_truth", "sweep_predicted"):
        save(run / "rollouts" / f"{name}.h5", scenes(4))
    (run / "videos").mkdir()
    (run / "videos" / "scene-0003-top.mp4").write_bytes(b"moving")
    (run / "videos" / "scene-0003-top.jpg").write_bytes(b"still")
    page = page_of(run)
    text = page.text
    assert page.tags[0][0] == "html"
    # Numbers as measured: errors of all rows, rates as percent, intervals, units.
    for number in ("0.0123", "0.457", "0.00321", "0.111", "1.37", "0.0456", "0.988", "432"):
        assert number in text
    for number in ("0.125\N{NO-BREAK SPACE}%", "3.75\N{NO-BREAK SPACE}%", "[1.88, 7.50]", "13.4\N{NO-BREAK SPACE}m"):
        assert number.replace("\N{NO-BREAK SPACE}", " ") in text.replace("\N{NO-BREAK SPACE}", " ")
    assert "[12.1, 14.9]" in text
    assert "more than the expert" in text  # contact intervals [0.06, 0.25] and [1.9, 7.5] are apart
    assert "trained for 200 gradient steps (4 seconds)" in text
    assert "77 scenes that it had never seen (seed 99), 5 control steps of 0.5 s" in text
    assert "2 agents and 1 obstacle" in text
    assert "Training is not finished: 200 of 300" in text
    assert "Still to be made" not in text
    names = [dict(attributes) for tag, attributes in page.tags if tag == "img"]
    assert len(names) == 6
    video = next(attributes for tag, attributes in page.tags if tag == "video")
    assert {"controls", "muted", "loop", "playsinline"} <= set(video)
    assert video["poster"].startswith("data:image/jpeg;base64,")
    assert "Scene 3: expert | model" in text
    # Nothing is fetched from anywhere.
    assert not [tag for tag, _ in page.tags if tag in ("script", "link", "iframe")]
    for _, attributes in page.tags:
        for key in ("src", "href", "srcset", "poster"):
            assert attributes.get(key, "data:").startswith("data:")
    assert "http" not in (Path(__file__).parent.parent / "swarmnet" / "report.css").read_text()
    assert not list(run.glob("*.partial*"))


def test_a_prediction_of_recordings(tmp_path) -> None:
    run = tmp_path / "walks"
    about = {
        "preset": "best",
        "train": TRAIN | {"model": "best"},
        "data": {
            "scenes": 50,
            "import": {"command": "swarmnet import w.csv --out w.h5"},
            "learn": {"data": "w.h5"},
        },
        "model": {"window": 1},
    }
    checkpoints = Checkpoints(run / "checkpoints")
    checkpoints.save(300, {"step": np.zeros(())}, about)
    checkpoints.close()
    add_evaluation(run, collisions={}, contacts=False, data="w_holdout.h5", said=["speed <3> m/s"], seed=None)
    document = json.loads((run / "evaluation.json").read_text())
    for k, row in enumerate(document["prediction"].values()):
        row |= {"ade": [0.031, 0.32 + k], "fde": [0.031, 0.61 + k], "paths": [987, 876], "displacement": [0.03, None]}
    (run / "evaluation.json").write_text(json.dumps(document))
    for name in ("truth", "predicted"):
        save(run / "rollouts" / f"{name}.h5", scenes(3))
    (run / "videos").mkdir()
    (run / "videos" / "window-1.mp4").write_bytes(b"moving")
    page = page_of(run)
    for words in (
        "judged by its prediction of 77 recorded scenes (w_holdout.h5), 5 steps of 0.5 s",
        "After 2.5 s it is 0.61 m (swarmnet best) off on average; 1.61 m (constant velocity) and 2.61 m",
        "Displacement after 2.5 s",
        "The same window twice",
        "Displacement error [m]",
        "987",
        "Predicted over recorded",
        "Speed <3> m/s.",
        "swarmnet import w.csv --out w.h5",
        "swarmnet learn w.h5",
        f"swarmnet evaluate {run} --data w_holdout.h5",
    ):
        assert words in page.text
    for words in ("cannot steer", "bodies pass through", "In closed loop", "Worst scenes", "Still to be made"):
        assert words not in page.text


def test_every_figure_of_a_collision_report_has_its_row(tmp_path) -> None:
    report = {name: vars(value) for name, value in collision_report(scenes()).items()}
    add_evaluation(tmp_path, collisions={"expert": report, "swarmnet best": report})
    page = page_of(tmp_path)
    rows = {attributes["id"] for tag, attributes in page.tags if tag == "tr" and "id" in attributes}
    assert rows == set(report)
    assert "$" not in page.text


def test_only_trained(tmp_path) -> None:
    run = tmp_path / "run"
    add_model(run)
    text = page_of(run).text
    assert "trained for 200 gradient steps" in text
    assert f"swarmnet evaluate {run}" in text
    assert "Not judged yet" in text
    assert "swarmnet train DATA" not in text
    assert "Learning" in text
    assert "Prediction error" not in text
    assert "In closed loop" not in text


def repaired_document(**changes) -> dict:
    """What `swarmnet repair` writes, with numbers of its own."""
    rounds = [
        {"round": k, "contact_steps": 0.0213 / (k + 1), "contact_steps_agent": 0.0111, "contact_steps_obstacle": 0.0102,
         "trajectories": 0.25 * (1 - k), "scenes": 64, "avoidable": 0.0456 * (1 - k), "violated": 0.05,
         "goal_distance": 11.7, "changed": 0.789 * k}
        for k in range(2)
    ]  # fmt: skip
    return {
        "status": "feasible",
        "best_round": 1,
        "verification": {"rows": 1234, "avoidable": 0},
        "settings": {"free": ["edge/<b>/*"], "constraint": {"name": "barrier", "margin": 0.5, "share": 0.7}},
        "rounds": rounds,
    } | changes


def test_a_repair_says_what_it_guarantees(tmp_path) -> None:
    (tmp_path / "repair.json").write_text(json.dumps(repaired_document()))
    text = page_of(tmp_path).text
    for words in (
        "Only edge/<b>/* were changed",
        "margin 0.5 m, 70% of the brakes",
        "of 1234 decisions that broke it without need while the policy was repaired, all of them keep it now",
        "checked in 64-bit arithmetic",
        "had a contact; with 95% confidence at most 4.6%",  # 1 - 0.05^(1/64)
        "What is not claimed:",
        "Status: feasible",
        "What fewer contacts cost",
        "Repair, round by round",
        "2.13",
        "0.789",
    ):
        assert words in text
    document = repaired_document(status="elastic", verification={"rows": 1234, "avoidable": 7})
    (tmp_path / "repair.json").write_text(json.dumps(document))
    assert "7 of them still break it" in page_of(tmp_path).text


def test_a_damaged_repair_is_named(tmp_path) -> None:
    for text in ("{", "{}", "[]", json.dumps(repaired_document(best_round=9))):
        (tmp_path / "repair.json").write_text(text)
        with pytest.raises(SwarmError, match=r"repair\.json: is damaged"):
            write_report(tmp_path)


def test_empty_and_missing_folders(tmp_path) -> None:
    text = page_of(tmp_path).text
    assert f"swarmnet train DATA.h5 --run {tmp_path}" in text
    assert "no trained model" in text
    with pytest.raises(SwarmError, match="nowhere: no such run folder"):
        write_report(tmp_path / "nowhere")


def test_what_a_folder_cannot_say(tmp_path) -> None:
    add_evaluation(tmp_path, contacts=False)
    page = page_of(tmp_path)
    assert "Contacts are off in this world" in page.text
    assert "Something touches" not in page.text
    add_evaluation(tmp_path, collisions={})
    text = page_of(tmp_path).text
    assert "it cannot steer agents" in text
    assert "In closed loop: contacts" not in text


def test_what_files_say_is_escaped(tmp_path) -> None:
    run = tmp_path / "<b>run"
    add_model(run, preset=NASTY)
    add_evaluation(run, name=NASTY, hardware={NASTY: NASTY}, versions={NASTY: NASTY}, commit=NASTY)
    page = page_of(run)
    assert "script" not in {tag for tag, _ in page.tags}
    assert NASTY in page.text
    assert "Run <b>run" in page.text
    assert "Hardware that wrote this page" not in page.text


def test_commands_parse_and_say_what_was_done(tmp_path) -> None:
    run = tmp_path / "a run"
    add_model(run)
    add_evaluation(run)
    save(run / "rollouts" / "expert.h5", scenes())
    save(run / "rollouts" / "learned.h5", scenes())
    parsed = {type(config): config for config in map(_parsed, commands(gather(run)))}
    simulate, train = parsed[Simulate], parsed[Train]
    assert {name: getattr(simulate, name) for name in SIMULATE} == SIMULATE
    assert train.data == (simulate.out,)
    assert (train.run, train.model, train.stage_steps, train.horizons) == (run, "thesis-ch5", (100, 200), (1, 5))
    assert train.noise == 0.1
    assert round(train.validation * 60) == 10
    assert (parsed[Evaluate].run, parsed[Evaluate].scenes, parsed[Evaluate].seed) == (run, 77, 99)
    assert parsed[Report].run == run
    assert parsed[Render].data == (run / "rollouts" / "expert.h5", run / "rollouts" / "learned.h5")
    add_evaluation(run, asked={"filter": "barrier", "num_agents": 7})
    judged = next(c for c in map(_parsed, commands(gather(run))) if isinstance(c, Evaluate))
    assert (judged.filter, judged.num_agents) == ("barrier", 7)
    demo = {"name": "x", "scenes": 44, "test_scenes": 5, "model": "best", "scale": 0.1, "seed": 7, "engine": "auto"}
    (run / "config.json").write_text(json.dumps(demo | {"videos": 0}))
    parsed = {type(config): config for config in map(_parsed, commands(gather(run)))}
    assert {name: getattr(parsed[Demo], name) for name in demo} == demo
    assert parsed[Demo].videos == 3
    assert Train not in parsed


def test_the_command_of_a_repair_has_its_switches_and_its_empty_lists(tmp_path) -> None:
    how = LoopConfig(method="thesis", constraint=ConstraintConfig(name="diamond"), agents=False, polish=())
    settings = json.loads(json.dumps(plain(how)))
    line = _repair_command(replace(gather(tmp_path), about={"repair": {"settings": settings}}), Path("runs/few"))
    words = _parsed((line, ""))
    assert (words.method, words.agents, words.polish, words.constraint.name) == ("thesis", False, (), "diamond")


def _parsed(line: tuple[str, str]):
    program, *words = shlex.split(line[0])
    assert program == "swarmnet"
    return parse(words)


def test_a_folder_that_cannot_be_written_leaves_the_old_report(tmp_path, monkeypatch) -> None:
    add_evaluation(tmp_path)
    before = write_report(tmp_path).read_text()
    (tmp_path / "evaluation.json").write_text("{}")
    with pytest.raises(SwarmError, match=r"evaluation\.json"):
        write_report(tmp_path)
    assert (tmp_path / "report.html").read_text() == before
