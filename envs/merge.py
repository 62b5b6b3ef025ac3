"""Shards of one simulation -> the file that one call would have written, to the byte."""

from collections.abc import Sequence
from pathlib import Path

from envs.storage import Header, join, read_header
from envs.trajectories import TrajectoryError


def merge(parts: Sequence[str | Path], path: str | Path) -> Header:
    """Joins the shards `parts`, in any order, into `path` and returns its header; only 256 scenes are in memory.

    A file that already holds exactly this is kept. Raises TrajectoryError, and writes nothing, when a part is damaged
    or no shard, when parts are of different simulations or versions, when one is given twice, and when some are
    missing; it names them.
    """
    path = Path(path)
    headers = [read_header(part) for part in parts]
    if not headers:
        raise TrajectoryError(f"{path}: no shards to merge")
    ordered = _complete(headers)
    about = {key: value for key, value in ordered[0].provenance.items() if key != "shard"}
    if path.exists():
        header = read_header(path)
        if "shard" in header.provenance or header.provenance.get("fingerprint") != about["fingerprint"]:
            raise TrajectoryError(f"{path}: exists and holds something else; choose another name or delete it first")
        return header
    join([header.path for header in ordered], path, about)
    return read_header(path)


def _complete(headers: list[Header]) -> list[Header]:
    """The shards in order. Raises TrajectoryError unless they are all shards of one simulation, each once."""
    first, found = headers[0], {}
    for header in headers:
        shard = header.provenance.get("shard")
        if shard is None:
            raise TrajectoryError(f"{header.path}: not a shard (`swarmnet simulate --shard` makes them)")
        if header.provenance["fingerprint"] != first.provenance["fingerprint"] or shard["of"] != _of(first):
            raise TrajectoryError(f"{header.path}: does not belong to {first.path}: {_difference(header, first)}")
        if shard["number"] in found:
            earlier = found[shard["number"]].path
            raise TrajectoryError(f"{header.path}: shard {shard['number']}/{shard['of']} again, as {earlier}")
        if header.scenes != shard["last"] - shard["first"] + 1:
            raise TrajectoryError(f"{header.path}: holds {header.scenes} scenes, its shard has another number of them")
        found[shard["number"]] = header
    missing = [f"{number}/{_of(first)}" for number in range(1, _of(first) + 1) if number not in found]
    if missing:
        raise TrajectoryError(f"{first.path}: its shards {', '.join(missing)} are missing")
    return [found[number] for number in sorted(found)]


def _of(header: Header) -> int:
    return header.provenance["shard"]["of"]


def _difference(one: Header, other: Header) -> str:
    """What two shards were made with that is not the same, for a person."""
    differing = []
    for part in ("simulate", "versions", "world"):
        mine, others = one.provenance[part], other.provenance[part]
        for key in sorted(mine.keys() | others.keys()):
            if mine.get(key) != others.get(key):
                differing.append(f"{key} {mine.get(key)!r}, not {others.get(key)!r}")
        if differing:
            return "; ".join(differing)
    if _of(one) != _of(other):
        return f"one of {_of(one)} shards, not of {_of(other)}"
    return "made on a machine that computes in other blocks"
