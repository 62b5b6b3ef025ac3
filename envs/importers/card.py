"""The card of an imported data set: source, licence, units, counts, figures, gaps, outliers and the command."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from envs.importers.config import ImportConfig
from envs.importers.samples import Samples
from envs.importers.scenes import Scene
from envs.importers.survey import Survey
from envs.plain import plain

LISTED = 1000
"""Gaps that the card lists; all are counted."""
KEPT = 50
"""Files, gaps and outliers that provenance lists: HDF5 attributes are small."""


def card(
    *,
    sources: Sequence[dict],
    config: ImportConfig,
    dt: float,
    read: Sequence[Samples],
    runs: Sequence[Samples],
    figures: Survey,
    divided: str,
    command: str,
) -> dict:
    """What holds for the whole import, plain JSON. `runs` are those of `read` that have agents."""
    gaps = [gap for run in runs for gap in run.gaps]
    about = {key: value for key, value in asdict(figures).items() if key not in ("outliers", "outlying", "thresholds")}
    return {
        "source": config.source,
        "licence": config.licence,
        "command": command,
        "files": list(sources),
        "dt": dt,
        "options": plain(config),
        "runs": len(runs),
        "agents": sum(len(np.unique(run.person[run.agents])) for run in runs),
        "seconds": float(sum((run.rows - 1) * dt for run in runs)),
        "agent_rows": int(sum(run.agents.sum() for run in runs)),
        "figures": about,
        "left_out": _left_out(read),
        "gaps": {
            "policy": config.gap,
            "count": len(gaps),
            "bridged": sum(gap.bridged for gap in gaps),
            "longest": max((gap.length for gap in gaps), default=0.0),
            "listed": [asdict(gap) for gap in gaps[:LISTED]],
        },
        "outliers": {
            "thresholds": {what: "none" if value == np.inf else value for what, value in figures.thresholds.items()},
            "count": figures.outlying,
            "listed": [asdict(outlier) for outlier in figures.outliers],
        },
        "division": divided,
    }


def _left_out(read: Sequence[Samples]) -> dict:
    """Ids without a row on the grid, and runs without an agent."""
    of_ids = sum(len(run.tracks.labels) for run in read)
    lost = [run.tracks.name for run in read if not run.agents.any()]
    return {
        "ids": of_ids - sum(len(np.unique(run.person)) for run in read),
        "of_ids": of_ids,
        "runs": len(lost),
        "of_runs": len(read),
        "listed": lost,
    }


def part(name: str, runs: Sequence[Samples], scenes: Sequence[Scene], rows: int) -> dict:
    """What holds for one file of the import: the training part, the held-out part, or everything."""
    return {
        "part": name,
        "part_runs": len(runs),
        "part_agents": sum(len(np.unique(run.person[run.agents])) for run in runs),
        "part_agent_rows": int(sum(run.agents.sum() for run in runs)),
        "rows_in_scenes": int(sum(scene.run.agents[scene.which].sum() for scene in scenes)),
        "scenes": len(scenes),
        "rows_per_scene": rows,
    }


def brief(about: dict) -> dict:
    """The card for the file's provenance: long lists are cut."""
    short = {what: about[what] | {"listed": about[what]["listed"][:KEPT]} for what in ("left_out", "gaps", "outliers")}
    return about | short | {"files": about["files"][:KEPT], "number_of_files": len(about["files"])}


def echo(about: dict) -> str:
    """The lines that show a wrong unit or frame rate at a glance."""
    figures, dt = about["figures"], about["dt"]
    low, median, high = figures["speed"]
    lines = [
        f"{about['runs']} {'run' if about['runs'] == 1 else 'runs'}, {about['agents']} agents, "
        f"{about['seconds']:.6g} s, rows {dt:g} s apart; "
        f"{figures['present'][1]:g} agents at a time (at most about {figures['present'][2]:g})",
        f"median speed {median:.3g} m/s = {3.6 * median:.3g} km/h (1% to 99%: {low:.3g} to {high:.3g} m/s), median "
        f"acceleration {figures['acceleration'][1]:.3g} m/s^2",
    ]
    if figures["spacing"]:
        low, median, high = figures["spacing"]
        lines.append(f"median distance to the nearest other {median:.3g} m (1% to 99%: {low:.3g} to {high:.3g} m)")
    facts: dict[tuple, list[str]] = {}
    for source in about["files"]:
        facts.setdefault(tuple(source["facts"].items()), []).append(source["name"])
    for fact, names in facts.items():
        lines.append(f"{_some(names, len(names))}: " + "; ".join(f"{key}: {value}" for key, value in fact))
    if lost := _lost(about):
        lines.append(f"left out: {'; '.join(lost)}")
    gaps, outliers = about["gaps"], about["outliers"]
    if gaps["count"]:
        lines.append(
            f"{gaps['count']} gaps, {gaps['bridged']} bridged, the longest {gaps['longest']:.3g} s "
            f"(policy {gaps['policy']})"
        )
    limits = ", ".join(f"{what} above {_figure(value)}" for what, value in outliers["thresholds"].items())
    lines.append(f"{outliers['count']} outliers ({limits}), kept" + (": see the card" if outliers["count"] else ""))
    lines.append(about["division"])
    return "\n".join(lines)


def _lost(about: dict) -> list[str]:
    """What was left out and why, in words; nothing for cards of before it was counted."""
    lost, said = about.get("left_out"), []
    if lost is None:
        return said
    if lost["ids"]:
        said.append(f"{lost['ids']} of {lost['of_ids']} ids, with too few rows for steps of {about['dt']:g} s")
    if lost["runs"]:
        said.append(
            f"{lost['runs']} of {lost['of_runs']} runs, with no agent left ({_some(lost['listed'], lost['runs'])})"
        )
    if cut := about["part_agent_rows"] - about["rows_in_scenes"]:
        said.append(
            f"{cut} of {about['part_agent_rows']} rows of agents, in segments that have agents in one row only "
            f"({about['part']})"
        )
    return said


def _some(names: Sequence[str], count: int, most: int = 3) -> str:
    """The first of `count` names."""
    return ", ".join(names[:most]) + (f" and {count - most} more" if count > most else "")


def render(about: dict, name: str) -> str:
    """The card as a Markdown page for the file `name`."""
    lines = [
        f"# {name}",
        "",
        f"Source: {about['source'] or 'not declared (--source)'}",
        f"Licence: {about['licence'] or 'not declared (--licence)'}",
        "",
        f"{about['part'].capitalize()}: {about['part_runs']} runs, {about['part_agents']} agents, "
        f"{about['scenes']} scenes of {about['rows_per_scene']} rows.",
        "",
        "```",
        echo(about),
        "```",
        "",
        "Figures are of all parts together.",
        "",
        "Written by",
        "",
        f"    {about['command'] or 'envs.importers.import_files'}",
        "",
        "| file | bytes | sha256 |",
        "|---|---:|---|",
        *(f"| {file['name']} | {file['bytes']} | {file['sha256']} |" for file in about["files"]),
    ]
    if lost := about.get("left_out", {}).get("listed"):
        lines += [
            "",
            f"## Runs left out: {len(lost)} of {about['left_out']['runs']}",
            "",
            *(f"- {name}" for name in lost),
        ]
    for what, columns in (
        ("gaps", ("run", "id", "start", "length", "bridged")),
        ("outliers", ("run", "id", "time", "what", "value")),
    ):
        entries = about[what]["listed"]
        if entries:
            lines += [
                "",
                f"## {what.capitalize()}: {len(entries)} of {about[what]['count']}",
                "",
                "| " + " | ".join(columns) + " |",
                "|" + "---|" * len(columns),
                *("| " + " | ".join(_figure(entry[column]) for column in columns) + " |" for entry in entries),
            ]
    return "\n".join(lines) + "\n"


def _figure(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
