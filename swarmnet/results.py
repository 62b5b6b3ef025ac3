"""Machine-readable results, the same for every command that measures, with all that is needed to measure again."""

import datetime
import json
import os
import platform
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from envs.trajectories import versions
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.whole import WholeFile

UNEVEN = 2
"""Factor between the gradient steps of a row's seeds above which equal minutes were not equal work, and are marked."""


@dataclass(frozen=True)
class Row:
    """One figure. `std` and `reference` (the thesis's figure) are None where there is none."""

    row: str
    column: str
    value: float | int
    std: float | None = None
    reference: float | None = None
    unit: str = ""
    more: dict = field(default_factory=dict)
    """What else a reader must know of this figure; stands beside the other entries in the file."""


@dataclass(frozen=True, kw_only=True)
class Results:
    """What a measuring command found."""

    name: str
    rows: list[Row]
    dt: float | None = None
    """Control step [s]; None where it has no meaning."""
    seeds: list[int] = field(default_factory=list)
    profile: str = "default"
    more: dict = field(default_factory=dict)
    """Further entries of the document, such as `missing`; they also replace what is found out when writing (`command`,
    `commit`, `hardware`, `versions`) where the figures are of another day."""


def write_results(path: str | Path, results: Results) -> None:
    """Writes JSON, whole or not at all. Non-finite values become null."""
    path = Path(path)
    rows = [_flat(row) for row in results.rows]
    document = {
        "name": results.name,
        "command": _command(sys.argv[1:]),
        "commit": commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "profile": results.profile,
        "hardware": hardware(),
        "versions": {"python": platform.python_version(), **versions()},
        "dt": results.dt,
        "seeds": results.seeds,
        **results.more,
        "rows": rows,
    }
    write_whole(path, json.dumps(document, indent=1) + "\n")


def _flat(row: Row) -> dict:
    values = asdict(row)
    more = values.pop("more")
    return {k: None if isinstance(v, float) and v - v != 0 else v for k, v in (values | more).items()}


def _command(arguments: list[str]) -> str:
    """The command that measures this again. Where its results were written is nobody's business, nor are the folders
    above those that it read: paths are said from here, and those elsewhere by their names."""
    kept = list(arguments)
    if "--json" in kept:
        at = kept.index("--json")
        del kept[at : at + 2]
    return " ".join(["swarmnet", *(_from_here(word) for word in kept)])


def _from_here(word: str) -> str:
    path = Path(word)
    if not path.is_absolute():
        return word
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else path.name


def write_whole(path: Path, content: str | bytes) -> None:
    """Writes a file under a temporary name and renames it. Raises SwarmError with the reason."""
    try:
        with WholeFile(path) as part:
            part.write_bytes(content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise SwarmError(f"{path}: cannot be written ({error.strerror})") from error


def hardware() -> dict:
    """Processor, cores, memory, and JAX's devices."""
    import jax

    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = lines[0].split(":", 1)[1].strip() if lines else model
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30 if hasattr(os, "sysconf") else None
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": None if memory is None else round(memory, 1),
        "devices": sorted({device.device_kind for device in jax.devices()}),
    }


def commit() -> str | None:
    """Commit of the checkout this file lies in, with `+` when it has changes; None for an installed package."""
    here = Path(__file__).resolve().parent
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"],
            cwd=here, capture_output=True, text=True, check=True, timeout=10,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()


def render_page(folder: str | Path) -> str:
    """docs/results.md from the committed docs/results/*.json: a table for each, with what it was measured on."""
    lines = [
        "# Results",
        "",
        "Rendered from `docs/results/*.json` by `make docs`; every file was written by the command it names.",
    ]
    paths = sorted(Path(folder).glob("[!.]*.json"))
    pictures = _pictures(Path(folder).parent / "media", [path.stem for path in paths])
    for path in paths:
        document = json.loads(path.read_text())
        machine, used = document["hardware"], document["versions"]
        columns = list(dict.fromkeys(row["column"] for row in document["rows"]))
        names = list(dict.fromkeys(row["row"] for row in document["rows"]))
        cells = {(row["row"], row["column"]): row for row in document["rows"]}
        most = max((row.get("n", 1) for row in document["rows"]), default=1)
        lines += [
            "",
            f"## {path.stem}",
            "",
            f"`{document['command']}`, commit {document['commit']}, {document['date'][:10]}, {machine['cpu']} with "
            f"{machine['cores']} cores, {', '.join(machine['devices'])}, mujoco {used['mujoco']}, jax {used['jax']}"
            + (f", dt {document['dt']} s" if document["dt"] else "")
            + (f", seeds {', '.join(map(str, document['seeds']))}" if document["seeds"] else ""),
            *(f"\n{text}" for text in [*_effort(document["rows"]), *_remarks(document)]),
            "",
            "| | " + " | ".join(names) + " |",
            "|---|" + "---:|" * len(names),
        ]
        bounds = {end: column for column in columns for end in (f"{column}, low", f"{column}, high")}
        for column in (column for column in columns if column not in bounds):
            shown = [
                _cell(
                    cells.get((name, column)), most, [cells.get((name, f"{column}, {end}")) for end in ("low", "high")]
                )
                for name in names
            ]
            lines.append(f"| {column} | " + " | ".join(shown) + " |")
        lines += [f"\n{text}" for text in uneven(document["rows"])]
        lines += [f"\n![{name}](media/{name}.png)" for name in pictures[path.stem]]
    return "\n".join(lines) + "\n"


def _pictures(folder: Path, names: Sequence[str]) -> dict[str, list[str]]:
    """Of each document the pictures NAME.png and NAME-*.png; one that fits several is the longest name's."""
    found: dict[str, list[str]] = {name: [] for name in names}
    for picture in sorted(path.stem for path in folder.glob("*.png")):
        fitting = [name for name in names if picture == name or picture.startswith(f"{name}-")]
        if fitting:
            found[max(fitting, key=len)].append(picture)
    return found


def _effort(rows: Sequence[Mapping]) -> list[str]:
    """What a cell of `swarmnet reproduce` had and took, from the least to the most of the rows."""

    def had(name: str, form: str) -> str:
        return span([row[name] for row in rows if row.get(name) is not None], form)

    demonstrations, minutes, seconds = had("demonstrations", "d"), had("minutes", "g"), had("wall_seconds", ".0f")
    # Where no gradient steps are counted, the minutes are the profile's, and the notes say what became of them.
    trained = any(row.get("steps") for row in rows)
    parts = [
        demonstrations and f"{demonstrations} demonstrations",
        minutes and (f"{minutes} min of training" if trained else f"a budget of {minutes} min"),
        seconds and f"{seconds} s a cell",
    ]
    return [", ".join(filter(None, parts))] if any(parts) else []


def span(values: Sequence[float | int], form: str = "d") -> str:
    """`3`, `3 to 7`, or nothing of nothing."""
    return " to ".join(dict.fromkeys(f"{end:{form}}" for end in (min(values), max(values)))) if values else ""


def uneven(rows: Sequence[Mapping]) -> list[str]:
    """A line for the rows whose seeds made numbers of gradient steps more than `UNEVEN` times apart, if any."""
    columns: dict[tuple, list[str]] = {}
    for row in rows:
        steps = row.get("steps", [])
        if steps and max(steps) > UNEVEN * min(steps):
            columns.setdefault((row["row"], tuple(steps)), []).append(row["column"])
    all_of = Counter(row["row"] for row in rows)
    found = [
        row + ("" if len(of) == all_of[row] else f" / {', '.join(of)}") + f": {span(steps)} gradient steps"
        for (row, steps), of in columns.items()
    ]
    return ["uneven: " + "; ".join(found)] if found else []


def _remarks(document: dict) -> list[str]:
    """What a reader must know before the figures."""
    smoke = ["**Smoke run (profile `quick`), not to be quoted.**"] if document["profile"] == "quick" else []
    return [*smoke, *([document["notes"]] if "notes" in document else []), *unfinished(document)]


def unfinished(document: Mapping) -> list[str]:
    """A line for the cells (row, data, seed) that a document names as missing, and one for each that failed."""
    found: dict[str, dict[str, list[str]]] = {}
    missing = document.get("missing", [])
    for cell in missing:
        found.setdefault(cell["row"], {}).setdefault(cell["data"], []).append(str(cell["seed"]))
    rows = (
        f"{row}: " + ", ".join(f"{data} ({' '.join(seeds)})" for data, seeds in by_data.items())
        for row, by_data in found.items()
    )
    lines = [f"{len(missing)} missing cells (seeds): " + "; ".join(rows)] if missing else []
    failed = document.get("failed", [])
    return lines + [f"failed: {one['row']}, {one['data']}, seed {one['seed']}: {one['reason']}" for one in failed]


def _cell(row: dict | None, most: int, bounds: Sequence[dict | None] = ()) -> str:
    """With the bounds `low` and `high` where both are known. Of `most` seeds nothing is said, of fewer how many."""
    if row is None or row["value"] is None:
        return ""
    text = f"{row['value']:.4g}" + (f" ± {row['std']:.2g}" if row["std"] is not None else "")
    ends = [bound["value"] for bound in bounds if bound is not None and bound["value"] is not None]
    text += f" [{ends[0]:.3g}, {ends[1]:.3g}]" if len(ends) == 2 else ""
    text += f" (n = {row['n']})" if row.get("n", most) < most else ""
    return text + (f" (thesis {row['reference']:.4g})" if row["reference"] is not None else "")


if __name__ == "__main__":
    write_whole(Path("docs/results.md"), render_page("docs/results"))
