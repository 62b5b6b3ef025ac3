"""Experiments in cells: what is done once, what is merged, what is missing, and who works on what."""

import json
import os
import subprocess
import sys
import textwrap
import time
import types
from dataclasses import replace
from pathlib import Path

import pytest
from learning import environment, published, quick_training, scales

import swarmnet.reproduce.work
from gnn.checkpoint import Model
from gnn.config import TrainConfig, model_preset
from gnn.decode import Integrator
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.cli import main, parse
from swarmnet.commands import reproduce as command
from swarmnet.config import Reproduce
from swarmnet.reproduce import table_4_1
from swarmnet.reproduce.borrow import Learning
from swarmnet.reproduce.cells import read_record, records, run_cells, write_record
from swarmnet.reproduce.experiment import PROFILES, REGISTRY, Cell, DataSet, Effort, Experiment, find
from swarmnet.reproduce.lock import Busy, locked
from swarmnet.reproduce.merge import merge, table
from swarmnet.reproduce.table_3_1 import TABLE_3_1
from swarmnet.reproduce.table_4_1 import TABLE_4_1
from swarmnet.results import Results, Row, render_page, write_results

EFFORT = Effort(profile="cpu", demonstrations=10, test_scenes=4, minutes=1.0, data=Path("unused"))


class Fake:
    """An experiment of millisecond cells: the value of a cell is its seed squared, plus 100 on the second data set."""

    def __init__(self) -> None:
        self.calls: list[Cell] = []
        self.breaks: dict[str, BaseException] = {}
        self.experiment = Experiment(
            name="fake",
            about="cells that take no time",
            rows=("best", "rival", "nothing"),
            data_sets=(DataSet("one", ("one 5", "one 40")), DataSet("two", ("two 5",), dt=0.1)),
            run=self.run,
            references={("best", "one 5"): 0.25},
            leading=("best",),
            untrained=("nothing",),
        )

    def run(self, cell: Cell, effort: Effort, folder: Path, progress) -> dict[str, float]:
        self.calls.append(cell)
        progress(1, 1)
        if cell.row in self.breaks:
            raise self.breaks[cell.row]
        value = float(cell.seed**2)
        return {"one 5": value, "one 40": 2 * value} if cell.data == "one" else {"two 5": value + 100}


@pytest.fixture
def fake(monkeypatch) -> Fake:
    fake = Fake()
    monkeypatch.setitem(sys.modules, "fake_experiment", types.SimpleNamespace(FAKE=fake.experiment))
    monkeypatch.setitem(REGISTRY, "fake", "fake_experiment:FAKE")
    return fake


def merged(fake: Fake, folder: Path, seeds=(0, 1, 2)):
    return merge(
        fake.experiment, fake.experiment.cells(seeds), folder, profile="cpu", command="swarmnet reproduce fake"
    )


def test_leading_rows_come_first_with_all_seeds_then_the_others_seed_by_seed(fake: Fake):
    cells = fake.experiment.cells((0, 1))
    assert [(cell.row, cell.data, cell.seed) for cell in cells] == [
        ("best", "one", 0), ("best", "two", 0), ("best", "one", 1), ("best", "two", 1),
        ("rival", "one", 0), ("rival", "two", 0), ("rival", "one", 1), ("rival", "two", 1),
        ("nothing", "one", 0), ("nothing", "two", 0),
    ]  # fmt: skip


def test_rows_and_columns_or_data_sets_choose_cells(fake: Fake):
    choose = fake.experiment.cells
    assert choose((3,), ("rival",), ("one 40",)) == choose((3,), ("rival",), ("one",)) == [Cell("rival", "one", 3)]
    with pytest.raises(SpecError, match=r"rows.*'worst'.*'best', 'rival', 'nothing'"):
        choose((0,), ("worst",))
    with pytest.raises(SpecError, match=r"columns.*'three'.*'one 5', 'one 40', 'two 5', 'one', 'two'"):
        choose((0,), (), ("three",))


def test_quick_shares_its_minutes_among_the_cells_that_train(fake: Fake, tmp_path: Path):
    assert fake.experiment.effort("quick", tmp_path).minutes == 6 / 4
    assert fake.experiment.effort("cpu", tmp_path).minutes == PROFILES["cpu"].minutes == 5
    assert fake.experiment.effort("cpu", tmp_path, 7.5).minutes == 7.5
    with pytest.raises(SpecError, match=r"profile.*'slow'.*quick, cpu, full"):
        fake.experiment.effort("slow", tmp_path)


def test_a_finished_cell_is_not_run_again_and_an_interrupted_one_is(fake: Fake, tmp_path: Path):
    cells = fake.experiment.cells((0,))
    fake.breaks["rival"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run_cells(fake.experiment, cells, EFFORT, tmp_path)
    assert fake.calls == cells[:3]
    fake.breaks.clear()
    outcome = run_cells(fake.experiment, cells, EFFORT, tmp_path)
    assert fake.calls == cells[:3] + cells[2:]
    assert outcome.done == tuple(cells)
    record = read_record(cells[0].path(tmp_path)) or {}
    assert record["values"] == {"one 5": 0.0, "one 40": 0.0}
    assert "steps" not in record  # it trained nothing
    assert {"demonstrations", "minutes", "wall_seconds", "dt", "hardware", "versions", "commit"} <= set(record)
    assert "minutes" not in (read_record(cells[-1].path(tmp_path)) or {})  # it learned nothing


def test_a_cell_that_fails_is_recorded_others_go_on_and_it_is_tried_again(fake: Fake, tmp_path: Path):
    cells = fake.experiment.cells((0,))
    fake.breaks |= {"best": SwarmError("the loss is nan"), "rival": ZeroDivisionError("by zero")}
    outcome = run_cells(fake.experiment, cells, EFFORT, tmp_path)
    assert outcome.failed == tuple(cells[:4])
    assert outcome.done == tuple(cells[4:])
    found = merged(fake, tmp_path, (0,)).more
    assert found["missing"] == []
    assert found["failed"][0] == {"row": "best", "data": "one", "seed": 0, "reason": "the loss is nan"}
    assert "ZeroDivisionError: by zero" in found["failed"][2]["reason"]
    assert "by zero" in (cells[2].path(tmp_path) / "error.txt").read_text()
    fake.breaks.clear()
    assert run_cells(fake.experiment, cells, EFFORT, tmp_path).failed == ()


def test_a_cell_that_another_process_works_on_is_left_to_it(fake: Fake, tmp_path: Path):
    cells = fake.experiment.cells((0,))
    with locked(cells[1].path(tmp_path) / "cell.lock"):
        outcome = run_cells(fake.experiment, cells, EFFORT, tmp_path)
        with pytest.raises(Busy, match="another process"), locked(cells[1].path(tmp_path) / "cell.lock"):
            pass
    assert outcome.busy == (cells[1],)
    assert cells[1] not in fake.calls
    assert run_cells(fake.experiment, cells, EFFORT, tmp_path).busy == ()
    assert cells[1] in fake.calls


def test_a_cell_that_has_just_failed_elsewhere_is_not_tried_again(fake: Fake, tmp_path: Path, monkeypatch):
    """As if a second job had failed at the second cell while this one did the first."""
    cells, run = fake.experiment.cells((0,)), fake.run

    def run_beside(cell: Cell, effort: Effort, folder: Path, progress) -> dict[str, float]:
        if cell == cells[0]:
            cells[1].path(tmp_path).mkdir(parents=True)
            write_record(cells[1].path(tmp_path), {"failed": "the loss is nan", "seed": 0})
        return run(cell, effort, folder, progress)

    monkeypatch.setattr(fake, "experiment", replace(fake.experiment, run=run_beside))
    outcome = run_cells(fake.experiment, cells[:3], EFFORT, tmp_path)
    assert (outcome.done, outcome.failed) == ((cells[0], cells[2]), (cells[1],))
    assert fake.calls == [cells[0], cells[2]]
    assert run_cells(fake.experiment, cells[1:2], EFFORT, tmp_path).done == (cells[1],)


def test_two_processes_share_the_cells_and_do_each_once(tmp_path: Path):
    script = f"""
        import os, time
        from pathlib import Path
        from swarmnet.reproduce.cells import run_cells
        from swarmnet.reproduce.experiment import DataSet, Effort, Experiment

        def run(cell, effort, folder, progress):
            with open(folder / "runs", "a") as file:
                file.write(f"{{os.getpid()}}\\n")
            time.sleep(0.1)
            return {{"x": 1.0}}

        shared = Experiment(name="x", about="", rows=tuple("abcdefgh"), data_sets=(DataSet("x", ("x",)),), run=run)
        ready, folder = Path({str(tmp_path)!r}), Path({str(tmp_path / "cells")!r})
        (ready / f"ready-{{os.getpid()}}").touch()
        while len(list(ready.glob("ready-*"))) < 2:
            time.sleep(0.01)
        effort = Effort(profile="cpu", demonstrations=1, test_scenes=1, minutes=1.0, data=folder)
        run_cells(shared, shared.cells((0,)), effort, folder)
    """
    both = [
        subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)], env=environment(), cwd=tmp_path)
        for _ in range(2)
    ]
    assert [process.wait(120) for process in both] == [0, 0]
    workers = [path.read_text().split() for path in sorted((tmp_path / "cells").glob("*/x/seed-0/runs"))]
    assert [len(pids) for pids in workers] == [1] * 8
    assert {pid for pids in workers for pid in pids} == {str(process.pid) for process in both}


def test_a_killed_process_frees_its_cell(tmp_path: Path):
    hold = f"""
        import time
        from pathlib import Path
        from swarmnet.reproduce.lock import locked
        with locked(Path({str(tmp_path / "cell.lock")!r})):
            print("held", flush=True)
            time.sleep(60)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(hold)], env=environment(), stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(Busy), locked(tmp_path / "cell.lock"):
            pass
        process.kill()
    with locked(tmp_path / "cell.lock"):
        pass


def test_mean_std_reference_and_what_is_missing(fake: Fake, tmp_path: Path):
    """Seeds 1, 2 and 3: values 1, 4 and 9, mean 14/3, variance (121 + 4 + 169) / 9 / 2 = 49/3."""
    cells = fake.experiment.cells((1, 2, 3), ("best",), ("one",)) + fake.experiment.cells((1,), ("rival",), ("two",))
    run_cells(fake.experiment, cells, EFFORT, tmp_path)
    results = merged(fake, tmp_path, (1, 2, 3))
    rows = {(row.row, row.column): row for row in results.rows}
    assert list(rows) == [("best", "one 5"), ("best", "one 40"), ("rival", "two 5")]
    best = rows["best", "one 5"]
    assert best.value == pytest.approx(14 / 3)
    assert best.std == pytest.approx((49 / 3) ** 0.5)
    assert (best.reference, rows["best", "one 40"].reference) == (0.25, None)
    assert best.more["n"] == 3
    assert best.more["seeds"] == [1, 2, 3]
    assert (best.more["profile"], best.more["dt"], best.more["demonstrations"], best.more["minutes"]) == (
        "cpu", 0.3, 10, 1.0,
    )  # fmt: skip
    assert (rows["rival", "two 5"].value, rows["rival", "two 5"].std, rows["rival", "two 5"].more["n"]) == (
        101,
        None,
        1,
    )
    assert rows["rival", "two 5"].more["dt"] == 0.1
    missing = [tuple(cell.values()) for cell in results.more["missing"]]
    assert len(missing) == 14 - 4
    assert ("best", "two", 1) in missing
    assert ("rival", "one", 3) in missing
    assert ("nothing", "two", 0) in missing
    assert ("best", "one", 1) not in missing
    printed = table(results)
    assert "4.667 ± 4" in printed
    assert "10 missing cells (seeds): best: two (1 2 3); rival: one (1 2 3), two (2 3); nothing: one (0)" in printed


def test_a_prediction_that_overflows_is_no_number_and_says_so(fake: Fake, tmp_path: Path):
    run = fake.experiment.run
    overflowing = replace(
        fake.experiment,
        run=lambda *job: run(*job) if job[0].seed else {"one 5": float("inf"), "one 40": float("nan")},
    )
    run_cells(overflowing, overflowing.cells((0, 1), ("best",), ("one",)), EFFORT, tmp_path)
    results = merge(overflowing, [], tmp_path, profile="cpu", command="")
    assert [row.more["diverged"] for row in results.rows] == [1, 1]
    assert "diverged" in table(results)
    write_results(tmp_path / "r.json", results)
    assert [row["value"] for row in json.loads((tmp_path / "r.json").read_text())["rows"]] == [None, None]


def test_cells_of_another_effort_are_refused(fake: Fake, tmp_path: Path):
    run_cells(fake.experiment, fake.experiment.cells((0,)), EFFORT, tmp_path)
    with pytest.raises(SwarmError, match=r"minutes 1\.0 -> 2\.0.*another --out"):
        run_cells(fake.experiment, fake.experiment.cells((1,)), replace(EFFORT, minutes=2.0), tmp_path)
    assert {cell.seed for cell, _ in records(fake.experiment, tmp_path)} == {0}


def test_the_command_runs_merges_and_names_what_made_the_document(fake: Fake, tmp_path: Path, capsys):
    out, file = ["--out", str(tmp_path)], tmp_path / "docs" / "fake.json"
    assert (
        main(["reproduce", "fake", "--profile", "cpu", "--rows", "best", "--seeds", "0", "--minutes", "2", *out]) == 0
    )
    assert "0.25" in capsys.readouterr().out
    assert len(fake.calls) == 2
    assert main(["reproduce", "fake", "--profile", "cpu", "--merge-only", "--json", str(file), *out]) == 0
    assert len(fake.calls) == 2
    document = json.loads(file.read_text())
    assert document["command"] == "swarmnet reproduce fake --profile cpu --minutes 2"
    assert document["profile"] == "cpu"
    assert document["rows"][0]["reference"] == 0.25
    assert document["rows"][0]["minutes"] == 2
    assert len(document["missing"]) == 14 - 2
    assert json.loads((tmp_path / "cpu" / "fake.json").read_text())["rows"] == document["rows"]


def test_the_exit_status_tells_of_failed_cells(fake: Fake, tmp_path: Path, capsys):
    fake.breaks["rival"] = SwarmError("the loss is nan")
    assert main(["reproduce", "fake", "--out", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert "failed: rival, one, seed 0: the loss is nan" in printed.out
    assert "4/6 fake: rival / two / seed 0: the loss is nan" in printed.err


def test_a_smoke_run_and_missing_cells_show_on_the_page(fake: Fake, tmp_path: Path):
    docs = tmp_path / "docs"
    arguments = ["--rows", "best", "--columns", "one", "--out", str(tmp_path), "--json", str(docs / "fake.json")]
    assert main(["reproduce", "fake", *arguments]) == 0
    page = render_page(docs)
    assert "**Smoke run (profile `quick`), not to be quoted.**" in page
    assert "5 missing cells (seeds): best: two (0); rival: one (0), two (0); nothing: one (0), two (0)" in page
    assert "| one 5 | 0 (thesis 0.25) |" in page


def judged(row: str, column: str = "a", **more) -> dict:
    """A row of a document as `swarmnet reproduce` writes it."""
    usual = {"demonstrations": 5000, "minutes": 2.0, "wall_seconds": 137.4, "n": 3, "steps": [900, 800, 700]}
    return {"row": row, "column": column, "value": 1.5, "std": 0.25, "reference": None} | usual | more


def rendered(folder: Path, rows: list[dict]) -> list[str]:
    """Lines of the page of one document that was made by hand."""
    about = {
        "name": "made",
        "command": "swarmnet reproduce made",
        "commit": "c",
        "date": "2026-01-01",
        "profile": "cpu",
    }
    machine = {"hardware": {"cpu": "x", "cores": 1, "devices": ["cpu"]}, "versions": {"mujoco": "3", "jax": "0"}}
    folder.mkdir(parents=True)
    (folder / "made.json").write_text(json.dumps(about | machine | {"dt": 0.3, "seeds": [0], "rows": rows}))
    return render_page(folder).splitlines()


def test_the_page_says_what_cells_had_and_took(tmp_path: Path):
    assert "5000 demonstrations, 2 min of training, 137 s a cell" in rendered(tmp_path / "a", [judged("x")])
    untrained = judged("nothing", demonstrations=None, minutes=None, steps=[], wall_seconds=1.0)
    more = judged("y", demonstrations=20000, minutes=2.5, wall_seconds=1261.5)
    lines = rendered(tmp_path / "b", [judged("x"), more, untrained])
    assert "5000 to 20000 demonstrations, 2 to 2.5 min of training, 1 to 1262 s a cell" in lines
    lines = rendered(tmp_path / "c", [judged("x", steps=[])])
    assert "5000 demonstrations, a budget of 2 min, 137 s a cell" in lines
    bench = {"row": "x", "column": "a", "value": 1.5, "std": None, "reference": None}
    assert not any("a cell" in line for line in rendered(tmp_path / "d", [bench]))


def test_the_page_marks_figures_of_fewer_seeds_than_others(tmp_path: Path):
    rows = [judged("x"), judged("y", n=1, std=None, reference=0.5), judged("z", n=2)]
    assert "| a | 1.5 ± 0.25 | 1.5 (n = 1) (thesis 0.5) | 1.5 ± 0.25 (n = 2) |" in rendered(tmp_path / "a", rows)
    assert "| a | 1.5 |" in rendered(tmp_path / "b", [judged("x", n=1, std=None)])


def test_bounds_stand_behind_their_value(tmp_path: Path):
    """Columns `a, low` and `a, high` are no lines of their own; one that has no value of its own is."""
    ends = [judged("x", "a, low", value=1.25), judged("x", "a, high", value=1.8351)]
    lines = rendered(tmp_path / "a", [judged("x"), judged("y"), *ends, judged("x", "b, low")])
    assert lines[-3:] == [
        "|---|---:|---:|",
        "| a | 1.5 ± 0.25 [1.25, 1.84] | 1.5 ± 0.25 |",
        "| b, low | 1.5 ± 0.25 |  |",
    ]


def test_the_page_marks_uneven_work(tmp_path: Path):
    """More than a factor of 2 between seeds: 800 and 7100 are, 700 and 1400 are not."""
    rows = [
        judged("x", "a", steps=[800, 900, 7100]),
        judged("x", "b", steps=[800, 900, 7100]),
        judged("y", "a", steps=[700, 1400]),
        judged("y", "b", steps=[700, 1401]),
        judged("z", "a", steps=[]),
    ]
    assert rendered(tmp_path / "a", rows)[-2:] == [
        "",
        "uneven: x: 800 to 7100 gradient steps; y / b: 700 to 1401 gradient steps",
    ]
    assert not any("uneven" in line for line in rendered(tmp_path / "b", rows[2:3]))


def test_the_page_shows_the_pictures_of_a_document(tmp_path: Path):
    """Its own and its variants, but not those of a document with a longer name, nor others'."""
    (tmp_path / "media").mkdir()
    for name in ("made", "made-best", "made-20-minutes", "made-20-minutes-x", "made2", "other"):
        (tmp_path / "media" / f"{name}.png").touch()
    rendered(tmp_path / "results", [judged("x")])
    (tmp_path / "results" / "made-20-minutes.json").write_text((tmp_path / "results" / "made.json").read_text())
    page = render_page(tmp_path / "results").split("\n## ")
    shown = [[line for line in part.splitlines() if line.startswith("!")] for part in page]
    assert shown == [
        [],
        ["![made-20-minutes](media/made-20-minutes.png)", "![made-20-minutes-x](media/made-20-minutes-x.png)"],
        ["![made](media/made.png)", "![made-best](media/made-best.png)"],
    ]


def test_the_terminal_says_what_cells_had_and_marks_uneven_work():
    more = {"n": 3, "dt": 0.3, "demonstrations": 5000, "minutes": 2.0, "wall_seconds": 137.4}
    untrained = more | {"demonstrations": None, "minutes": None, "steps": []}
    rows = [
        Row("x", "a", 1.5, more=more | {"steps": [800, 7100]}),
        Row("y", "a", 1.5, more=more | {"steps": [700]}),
        Row("z", "a", 1.5, more=untrained),
    ]
    printed = table(Results(name="made", rows=rows, profile="cpu"))
    head, *lines = [line.split() for line in printed.splitlines()[1:5]]
    assert head == ["ours", "n", "thesis", "demos", "min", "wall", "s", "steps"]
    assert lines[0] == ["x", "1.5", "3", "5000", "2", "137", "800", "to", "7100"]
    assert lines[1] == ["y", "1.5", "3", "5000", "2", "137", "700"]
    assert lines[2] == ["z", "1.5", "3", "137"]
    assert printed.splitlines()[-1] == "uneven: x: 800 to 7100 gradient steps"


def test_a_figure_is_drawn_from_finished_cells(fake: Fake, tmp_path: Path, monkeypatch, capsys):
    seen = []

    def figure(folder: Path, done) -> list[Path]:
        seen.extend(cell for cell, record in done if record["values"])
        return [folder / "fake.png"]

    monkeypatch.setitem(
        sys.modules, "fake_experiment", types.SimpleNamespace(FAKE=replace(fake.experiment, figure=figure))
    )
    assert main(["reproduce", "fake", "--rows", "best", "--out", str(tmp_path)]) == 0
    assert seen == [Cell("best", "one", 0), Cell("best", "two", 0)]
    assert str(tmp_path / "quick" / "fake" / "fake.png") in capsys.readouterr().out


def test_names_are_listed_and_an_unknown_one_is_refused_with_them(capsys):
    assert main(["reproduce"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == list(REGISTRY)
    assert main(["reproduce", "table-9.9"]) == 2
    assert "'table-9.9' was given, allowed is one of table-3.1, table-3.2" in capsys.readouterr().err


@pytest.mark.parametrize("name", list(REGISTRY))
def test_every_experiment_is_sound(name: str):
    experiment = find(name)
    assert experiment.name == name
    assert len(set(experiment.columns)) == len(experiment.columns)
    assert len(set(experiment.rows)) == len(experiment.rows)
    assert all(row in experiment.rows and column in experiment.columns for row, column in experiment.references)
    assert set(experiment.leading) | set(experiment.untrained) <= set(experiment.rows)
    places = {cell.path(Path("x")) for cell in experiment.cells((0, 1))}
    assert len(places) == len(experiment.cells((0, 1)))


def test_the_thesis_s_figures_stand_where_they_belong():
    """Some of each table, as printed in the thesis."""
    figures = {
        "table-3.1": {
            ("swarmnet thesis-ch3 context", "boids 40"): 2.778,
            ("lstm", "chaser 40"): 126.3,
            ("kipf", "helbing 5"): 0.4374,
            ("persistence", "boids 5"): None,
        },
        "table-3.2": {("kipf-decoder-conv1d-context", "boids 40"): 3.101},
        "table-4.1": {("kipf", "helbing N=20"): 1e6, ("seq2seq", "boids N=5"): None, ("seq2seq", "boids N=10"): 1.45},
        "table-4.2": {("trained (3,1)", "20,17"): 1932, ("tuned (10,x)", "5,2"): 0.0939},
        "table-4.3": {("5->5-10", "N=5"): 0.13, ("10->20", "N=20"): 0.62},
    }
    for name, some in figures.items():
        for (row, column), value in some.items():
            assert find(name).reference(row, column) == value


def test_jobs_share_the_cells_and_end_with_the_command(fake: Fake, tmp_path: Path, monkeypatch, capsys):
    """A helper is the same command with one job; what it was at is not done twice, what it left is done in the end."""
    started, first = [], fake.experiment.cells((0,))[0]

    class Helper:
        def __init__(self, command: list[str], **_):
            self.said: list[str] = []
            self.lock = locked(first.path(tmp_path / "quick" / "fake") / "cell.lock")
            self.lock.__enter__()
            started.append((command, self))

        def wait(self):
            if not self.said:
                self.lock.__exit__(None, None, None)  # it dies at its first cell
            self.said.append("waited for")

        def terminate(self):
            self.said.append("terminated")

        def communicate(self):
            self.said.append("let go")

    monkeypatch.setattr(command, "subprocess", types.SimpleNamespace(Popen=Helper, DEVNULL=None, PIPE=None))
    monkeypatch.setattr(command, "find", lambda name: fake.experiment)
    config = Reproduce(name="fake", out=tmp_path, jobs=2)
    assert command.run(config) == 0
    ((words, helper),) = started
    assert parse(words[3:]) == replace(config, jobs=1)
    assert helper.said == ["waited for", "terminated", "let go"]
    assert len(fake.calls) == len(set(fake.calls)) == len(fake.experiment.cells((0,)))
    assert fake.calls[-1] == first
    whole = Reproduce(
        name="table-3.1", profile="cpu", rows=("swarmnet best", "kipf"), columns=("boids dt0.1",), seeds=(0, 2),
        minutes=0.5, out=tmp_path, json=tmp_path / "t.json",
    )  # fmt: skip
    assert parse(command.arguments(whole)) == whole
    started.clear()
    command.run(Reproduce(name="fake", profile="cpu", out=tmp_path))
    assert not started  # minutes that are to be compared are not shared


def test_a_helper_ends_with_a_command_that_is_killed(tmp_path: Path):
    helper = "import os, time; from swarmnet.reproduce.helper import end_with_parent; end_with_parent(); time.sleep(60)"
    parent = (
        "import subprocess, sys, time\n"
        "found = subprocess.Popen([sys.executable, '-c', sys.argv[1]], stdin=subprocess.PIPE)\n"
        "print(found.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    words = [sys.executable, "-c", parent, helper]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment()) as running:
        assert running.stdout is not None
        number = int(running.stdout.readline())
        os.kill(number, 0)  # there
        running.kill()
        running.wait()
        assert ended(number, seconds=30)


def test_a_helper_that_is_done_ends_while_the_command_goes_on():
    words = [sys.executable, "-c", "from swarmnet.reproduce.helper import end_with_parent; end_with_parent()"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()) as done:
        assert done.wait(timeout=60) == 0
        assert done.stderr is not None
        assert not done.stderr.read()


def ended(process: int, *, seconds: float) -> bool:
    """Whether a process that is nobody's child here ends in time."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return True
        if Path(f"/proc/{process}/stat").exists() and " Z " in Path(f"/proc/{process}/stat").read_text():
            return True  # ended; whoever has adopted it does not look after it
        time.sleep(0.05)
    return False


def test_a_crowd_is_tested_with_the_network_of_the_same_row_and_seed(tmp_path: Path, monkeypatch):
    """Sizes learned from and tested on by cell of table 4.1; nothing is trained."""
    learned = []

    def trained_once(learning: Learning, agents: int, *_) -> str:
        learned.append((learning, agents))
        return learning.model

    fakes = {
        "trained_once": trained_once,
        "demonstrations": lambda world, effort, seed: world.num_agents,
        "unseen": lambda world, effort: 1000.0 * world.num_agents + effort.test_scenes,
        "errors": lambda model, unseen, horizons, names: {name: unseen for name in names},
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(table_4_1, name, fake)
    effort = replace(TABLE_4_1.effort("cpu", tmp_path), test_scenes=500)
    found = {}
    for cell in TABLE_4_1.cells((2,), ("swarmnet best", "kipf", "seq2seq"), ("boids", "boids crowd")):
        found[cell.row, cell.data] = TABLE_4_1.run(cell, effort, tmp_path, lambda *_, **__: None)
    assert found == {  # 1000 agents + scenes
        ("swarmnet best", "boids"): {"boids N=5": 5500, "boids N=10": 10500, "boids N=20": 20125},
        ("swarmnet best", "boids crowd"): {"boids N=200": 200_007},
        ("kipf", "boids"): {"boids N=5": 5500, "boids N=10": 10500, "boids N=20": 20125},
        ("seq2seq", "boids"): {"boids N=10": 10500},
    }
    others = [(Learning(model=name, seed=2), 10) for name in ("kipf", "seq2seq")]
    assert sorted(learned, key=str) == sorted([*[(Learning(model="best", seed=2), 10)] * 2, *others], key=str)


@pytest.mark.parametrize(("name", "tested"), [("kipf", 2), ("thesis-ch3", 9)])
def test_kipf_is_tested_on_an_eighth_of_the_scenes(name: str, tested: int, monkeypatch):
    seen = []
    monkeypatch.setattr(
        swarmnet.reproduce.work, "published_mean", lambda *given, **_: seen.append(len(given[2])) or float(len(seen))
    )
    model = Model(model_preset(name), scales(), Integrator(0.3, 15, 10.0, 5.0), {}, {})
    found = swarmnet.reproduce.work.errors(model, published(9, 12), (5, 40), ("near", "far"))
    assert (seen, found) == ([tested] * 2, {"near": 1, "far": 2})


def test_a_real_cell_trains_tests_and_goes_on_where_it_was(tmp_path: Path, monkeypatch):
    def short(model: str, seed: int, minutes: float) -> TrainConfig:
        return TrainConfig(model=model, seed=seed, horizons=(1, 2), stage_steps=(4, 2), chunk=2, batch=4)

    monkeypatch.setattr(swarmnet.reproduce.work, "curriculum", short)
    effort = Effort(profile="quick", demonstrations=8, test_scenes=3, minutes=1e-3, data=tmp_path / "data")
    cells = TABLE_3_1.cells((0,), ("swarmnet thesis-ch3", "constant velocity"), ("chaser",))
    with quick_training():
        outcome = run_cells(TABLE_3_1, cells, effort, tmp_path / "cells")
        assert not outcome.failed, [record["failed"] for _, record in records(TABLE_3_1, tmp_path / "cells")]
        place = cells[0].path(tmp_path / "cells")
        first = read_record(place) or {}
        (place / "cell.json").unlink()
        run_cells(TABLE_3_1, cells, effort, tmp_path / "cells")
    again = read_record(place) or {}
    assert again["values"] == first["values"]
    assert set(first["values"]) == {"chaser 5", "chaser 40"}
    assert again["steps"] == first["steps"] == 4  # one chunk of each stage: the least there is
    assert again["training_seconds"] == first["training_seconds"] > 0
    assert len(list((tmp_path / "data").glob("*.h5"))) == 2
    rest = (read_record(cells[1].path(tmp_path / "cells")) or {})["values"]
    assert 0 < rest["chaser 5"] < rest["chaser 40"]


def test_cells_of_another_machine_are_taken_for_done_and_merged(fake: Fake, tmp_path: Path, capsys):
    """The same as if all had run here; of what ran elsewhere nothing is drawn."""
    drawn: list[Cell] = []

    def figure(folder: Path, done) -> list[Path]:
        drawn.extend(cell for cell, _ in done)
        return []

    sys.modules["fake_experiment"].FAKE = replace(fake.experiment, figure=figure)
    one, other, all_here = (tmp_path / name for name in ("one", "other", "all"))
    call = ["reproduce", "fake", "--profile", "cpu", "--rows", "best"]
    assert main([*call, "--seeds", "0", "1", "--out", str(one)]) == 0
    assert main([*call, "--seeds", "0", "1", "2", "--out", str(all_here)]) == 0
    known = ["--known", str(one / "cpu" / "fake.json"), "--out", str(other)]
    fake.calls.clear()
    drawn.clear()
    for _ in range(2):  # again: all is done
        assert main([*call, "--seeds", "0", "1", "2", *known]) == 0
    fresh = [Cell("best", data, 2) for data in ("one", "two")]
    assert fake.calls == fresh
    assert drawn == 2 * fresh
    printed = capsys.readouterr().err
    assert "4 cells taken for done" in printed
    assert "0 cells taken for done" in printed
    here, there = (json.loads((place / "cpu" / "fake.json").read_text()) for place in (all_here, other))
    for row in (*here["rows"], *there["rows"]):
        del row["wall_seconds"]
    assert there["rows"] == here["rows"]
    assert there["missing"] == here["missing"]
    assert [cell["values"] for cell in there["cells"]] == [cell["values"] for cell in here["cells"]]


def test_seeds_of_unseen_scenes_are_refused():
    assert Reproduce(seeds=(999_999,)).seeds == (999_999,)
    with pytest.raises(SpecError, match=r"seeds.*1000000.*in 0\.\.999999"):
        Reproduce(seeds=(0, 1_000_000))


def test_known_results_that_do_not_fit_are_refused_before_anything_is_written(fake: Fake, tmp_path: Path, capsys):
    out = ["--profile", "cpu", "--out", str(tmp_path / "out")]
    assert main(["reproduce", "fake", "--profile", "cpu", "--seeds", "0", "--out", str(tmp_path)]) == 0
    file = tmp_path / "cpu" / "fake.json"
    document = json.loads(file.read_text())
    strange, torn = [dict(document["cells"][0], row="worst")], [{"row": "best"}]
    cases = {
        "minutes 5.0 -> 2.0": (document, ["--minutes", "2"]),
        "no cell worst / one / seed 0": (document | {"cells": strange}, []),
        "a cell lacks data, seed": (document | {"cells": torn}, []),
        "results of 'table-3.1', not of 'fake'": (document | {"name": "table-3.1"}, []),
        "carries no cells": ({k: v for k, v in document.items() if k != "cells"}, []),
        "is no document of results": ([1, 2], []),
    }
    for said, (content, more) in cases.items():
        file.write_text(json.dumps(content))
        assert main(["reproduce", "fake", "--known", str(file), *more, *out]) == 2
        assert said in capsys.readouterr().err
    assert main(["reproduce", "fake", "--known", str(tmp_path / "nothing.json"), *out]) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
