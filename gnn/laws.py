"""An expert's law beside what was learned: of one edge type, between two bodies, and as a predictor of its own."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Float

from envs.config import World
from envs.experts.config import BoidsConfig, ChaserConfig, ExpertConfig, HelbingConfig, expert_name
from envs.experts.registry import make_expert
from envs.noise import ActuationNoise, with_actuation_noise
from envs.record import Array
from envs.state import make_state
from gnn.decode import steered
from gnn.family import Params, Predict
from gnn.graph import EDGE_TYPES, Graph
from swarm_mjcf.errors import SpecError, SwarmError

NO_NOISE = ActuationNoise()


class LawError(SwarmError):
    """The expert has no law that belongs to edge types, or none that a graph's states are enough for."""


def check_kinds(kinds: tuple[str, ...]) -> None:
    """Raises SpecError for an unknown edge type."""
    for kind in kinds:
        if kind not in EDGE_TYPES:
            raise SpecError("kinds", kind, "some of " + ", ".join(EDGE_TYPES))


def same_rules[E: ExpertConfig](expert: E, kinds: tuple[str, ...], *, walls_stay: bool = False) -> E:
    """The expert with the rules that belong to these edge types; weights of the others are 0.

    Boids: agent edges carry cohesion, separation and alignment. The virtual walls are part of the obstacle rule, as
    coded, and go with it; `walls_stay` leaves that rule on, for a world whose obstacles are absent but whose walls are
    not. Helbing: goal term, agents, obstacles. Raises LawError for an expert that knows no types.
    """
    check_kinds(kinds)
    if isinstance(expert, BoidsConfig):
        off = {name: 0.0 for name in ("cohesion", "separation", "alignment") if "agent" not in kinds}
        off |= {} if "goal" in kinds else {"goal": 0.0}
        off |= {} if "obstacle" in kinds or (walls_stay and expert.walls) else {"obstacle": 0.0}
        return replace(expert, **off)
    if isinstance(expert, HelbingConfig):
        goal = expert.goal if "goal" in kinds else 0.0
        agents, obstacles = expert.agents and "agent" in kinds, expert.obstacles and "obstacle" in kinds
        return replace(expert, goal=goal, agents=agents, obstacles=obstacles)
    raise LawError(f"an expert whose rules belong to edge types is needed: boids or helbing, not {expert_name(expert)}")


def pair_force(
    expert: ExpertConfig, kind: str, receiver: Float[Array, "P 4"], sender: Float[Array, "P 4"]
) -> Float[Array, "P 2"]:
    """Acceleration [m/s^2] of a lone receiver due to one sender of a type, before any limit.

    States are positions and velocities. Between agents it is the law of two: Boids' averages are over one other, so in
    a swarm of n each pair counts 1/(n - 1) of it. Of an obstacle it is what the obstacle adds: the rule takes the
    nearest obstacle or wall alone. Raises LawError where the expert knows no such edges.
    """
    check_kinds((kind,))
    pairs = len(receiver)
    nothing = jnp.zeros((pairs, 0, 2), jnp.float32)
    receiver, sender = (jnp.asarray(x, jnp.float32)[:, None] for x in (receiver, sender))
    agents = jnp.concatenate([receiver, sender], axis=1) if kind == "agent" else receiver
    chases = isinstance(expert, ChaserConfig)
    if chases and kind != "agent":
        raise LawError(f"chasers know no {kind} edges")
    state = make_state(
        position=agents[..., :2],
        velocity=agents[..., 2:],
        goal=sender[:, 0, :2] if kind == "goal" else jnp.zeros((pairs, 2), jnp.float32),
        obstacle=sender[..., :2] if kind == "obstacle" else nothing,
        obstacle_velocity=sender[..., 2:] if kind == "obstacle" else nothing,
        target=jnp.broadcast_to(jnp.asarray([[1], [0]], jnp.int32), (pairs, 2, 1)) if chases else None,
    )
    policy = make_expert(expert if chases else same_rules(expert, (kind,)))
    force = policy(state, None, None)
    if kind == "obstacle":
        force = force - policy(replace(state, obstacle_present=jnp.zeros((pairs, 1), bool)), None, None)
    return force[:, 0]


def law_predict(world: World, noise: ActuationNoise = NO_NOISE) -> Predict:
    """The law itself as a predictor, with errors of a known size: what a model that is wrong by this much would get.

    Without noise it continues recordings of the same world (without contacts) to the rounding of float32. Noise is
    drawn anew for every window, agent and step, the same in every call without a `key`. Raises LawError for chasers,
    whose targets are no part of a graph's states.
    """
    if isinstance(world.expert, ChaserConfig):
        raise LawError("chasers' targets are not known to a predictor; boids, helbing or vicsek are needed")
    policy = with_actuation_noise(make_expert(world.expert), noise)

    def predict(
        params: Params, history: Array, graph: Graph, *, horizon: int, key: jax.Array | None = None
    ) -> Float[Array, "B h V 4"]:
        goals, obstacles, _ = graph.counts
        first = goals + obstacles

        def step(nodes: Array, key: jax.Array):
            around, agents = nodes[:, goals:first], nodes[:, first:]
            state = make_state(
                position=agents[..., :2],
                velocity=agents[..., 2:],
                goal=nodes[:, 0, :2] if goals else jnp.zeros((len(nodes), 2), nodes.dtype),
                obstacle=around[..., :2],
                obstacle_velocity=around[..., 2:],
                agent_present=graph.present[:, first:],
                obstacle_present=graph.present[:, goals:first],
            )
            wanted = policy(state, None, jax.random.split(key, len(nodes)))
            nodes = steered(nodes, wanted, graph, world.scene, clip=True)
            return nodes, nodes

        keys = jax.random.split(jax.random.key(0) if key is None else key, horizon)
        return jnp.swapaxes(jax.lax.scan(step, jnp.asarray(history[:, -1]), keys)[1], 0, 1)

    return predict
