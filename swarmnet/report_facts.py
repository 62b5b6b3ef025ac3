"""What a run folder says of itself, for its report."""

import json
from dataclasses import dataclass
from pathlib import Path

from envs.storage import load
from gnn.checkpoint import Checkpoints
from gnn.metrics import read_metrics
from swarm_mjcf.errors import SwarmError
from swarmnet.figures import read_evaluation


@dataclass(frozen=True)
class Facts:
    """What a run folder says; None where it holds nothing of the kind."""

    run: Path
    about: dict | None
    """Of the newest checkpoint."""
    evaluation: dict | None
    metrics: list[dict]
    counts: tuple[int, int, int] | None
    """Goals, obstacles and agents of the judged scenes."""
    demo: dict | None
    """Settings of `swarmnet demo`, when it made the folder."""

    @property
    def model(self) -> str:
        """The policy's row name."""
        e = self.evaluation or {}
        return e.get("policy") or next(iter(e.get("prediction", {})), "model")

    @property
    def reference(self) -> str:
        """The row name of what it is judged by."""
        return (self.evaluation or {}).get("reference") or "expert"

    @property
    def recorded(self) -> str:
        """File of the recorded trajectories that were predicted; empty where policies were judged by what they do."""
        return (self.evaluation or {}).get("data") or ""

    @property
    def ppo(self) -> dict | None:
        """Settings of the PPO that improved the model; None where none did."""
        return (self.about or {}).get("rl")

    @property
    def repair(self) -> dict | None:
        """What a repair left with the weights: settings, status; None where none was made."""
        return (self.about or {}).get("repair")

    @property
    def imitation(self) -> dict | None:
        """Description of what has learned by imitation: of the model, or of the one that PPO started from; None for
        random weights."""
        about = self.about
        while about and "rl" in about:
            about = about.get("initial")
        return about

    @property
    def origin(self) -> Path | None:
        """Run folder that PPO or a repair started from, where the evaluation names it as reference."""
        given = (self.evaluation or {}).get("given", {}).get("reference")
        return Path(given) if (self.ppo or self.repair) and given and (Path(given) / "checkpoints").is_dir() else None

    def pair(self, figure: str) -> tuple[dict, dict] | None:
        """Estimates of policy and reference, where both were measured; contact figures only with contacts on."""
        e = self.evaluation or {}
        reports = e.get("collisions") or {}
        if not {self.reference, self.model} <= set(reports) or ("contact" in figure and not e.get("contacts")):
            return None
        both = reports[self.model].get(figure), reports[self.reference].get(figure)
        return both if all(both) else None


def gather(run: Path) -> Facts:
    """Reads a run folder. Raises SwarmError for a file that cannot be read."""
    about = counts = demo = None
    if (run / "checkpoints").is_dir():
        checkpoints = Checkpoints(run / "checkpoints", read_only=True)  # a training may be saving beside us
        newest = checkpoints.newest()
        about = None if newest is None else newest[1] | {"step": newest[0]}
        checkpoints.close()
    for name in ("learned.h5", "expert.h5"):
        if (run / "rollouts" / name).exists():
            counts = load(run / "rollouts" / name, scenes=1).counts
    if (run / "config.json").exists():
        try:
            demo = json.loads((run / "config.json").read_text())
        except (OSError, ValueError) as error:
            raise SwarmError(f"{run / 'config.json'}: cannot be read ({error})") from error
    return Facts(run, about, read_evaluation(run), read_metrics(run / "metrics.jsonl"), counts, demo)
