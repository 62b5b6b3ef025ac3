"""`swarmnet reproduce`."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

from swarmnet.config import Reproduce
from swarmnet.reproduce.cells import claimed, records, run_cells
from swarmnet.reproduce.elsewhere import ELSEWHERE, adopt
from swarmnet.reproduce.experiment import PROFILES, REGISTRY, Experiment, find
from swarmnet.reproduce.merge import merge, table
from swarmnet.results import Results, write_results


def run(config: Reproduce) -> int:
    """Does what is missing, and prints, draws and writes what is there. 1 when a cell has failed."""
    if config.name is None:
        for name in REGISTRY:
            print(f"{name:12} {find(name).about}")
        return 0
    experiment = find(config.name)
    effort = experiment.effort(config.profile, config.out / "data", config.minutes)
    usual = PROFILES[config.profile].seeds
    cells = experiment.cells(config.seeds or usual, config.rows, config.columns)
    planned = experiment.cells(sorted({*usual, *config.seeds}))
    folder = config.out / config.profile / experiment.name
    file = config.json or folder.parent / f"{experiment.name}.json"

    def merged() -> Results:
        command = _command(config, experiment, claimed(folder).get("minutes"))
        results = merge(experiment, planned, folder, profile=config.profile, command=command)
        write_results(file, results)
        return results

    def finished(title: str, record: dict) -> None:
        found = record.get("failed") or ", ".join(f"{name}: {value}" for name, value in record["values"].items())
        print(f"{title}: {found} ({record['wall_seconds']:.0f} s)", file=sys.stderr, flush=True)
        merged()

    for document in config.known:
        print(f"{document}: {adopt(experiment, document, effort, folder)} cells taken for done", file=sys.stderr)
    if not config.merge_only:
        with helpers(config) as running:
            outcome = run_cells(experiment, cells, effort, folder, finished=finished)
            for helper in running:
                helper.wait()
        if running:  # done by now, or left by one that died
            outcome = run_cells(experiment, outcome.busy, effort, folder, finished=finished)
        for cell in outcome.busy:
            print(f"skipped, another process works on it: {cell}", file=sys.stderr)
    results = merged()
    print(table(results))
    print(f"\n{file}")
    here = [pair for pair in records(experiment, folder) if "values" in pair[1] and ELSEWHERE not in pair[1]]
    if experiment.figure and here:
        for path in experiment.figure(folder, here):
            print(path)
    return 1 if results.more["failed"] else 0


@contextlib.contextmanager
def helpers(config: Reproduce) -> Iterator[list[subprocess.Popen]]:
    """The other jobs, which do the same without a word; they end with the block, and when this process is killed."""
    jobs = config.jobs or (min(2, os.cpu_count() or 1) if config.profile == "quick" else 1)
    command = [sys.executable, "-m", "swarmnet.reproduce.helper", *arguments(config), "--jobs", "1"]
    silent, held = subprocess.DEVNULL, subprocess.PIPE
    running = [subprocess.Popen(command, stdin=held, stdout=silent, stderr=silent) for _ in range(jobs - 1)]
    try:
        yield running
    finally:
        for helper in running:
            helper.terminate()
            helper.communicate()  # waits, and closes what held it


def arguments(config: Reproduce) -> list[str]:
    """The words that give this configuration, without the number of jobs."""
    words = ["reproduce", str(config.name), "--profile", config.profile, "--out", str(config.out)]
    lists = {"--rows": config.rows, "--columns": config.columns, "--seeds": config.seeds}
    for option, values in lists.items():
        words += [option, *map(str, values)] if values else []
    for option, value in {"--minutes": config.minutes, "--json": config.json}.items():
        words += [] if value is None else [option, str(value)]
    return words


def _command(config: Reproduce, experiment: Experiment, minutes: float | None) -> str:
    """The one command that makes the whole document, whatever calls it took."""
    words = ["swarmnet reproduce", experiment.name, "--profile", config.profile]
    if minutes and minutes != experiment.effort(config.profile, config.out).minutes:
        words += ["--minutes", f"{minutes:g}"]
    return " ".join(words)
