"""Contacts of recorded positions, whoever recorded them: sphere geometry, looked at row by row or between rows as well.

Between two rows positions and velocities are interpolated linearly, so `states` of a control step are seen at times
`j dt / states`, j = 1 .. states, the last being the row itself. Definitions: `docs/definitions.md`.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from envs.touching import BY_AGENT, BY_OBSTACLE, BY_WALL, Touches
from envs.trajectories import AGENT, OBSTACLE, Trajectories
from swarm_mjcf.errors import SpecError
from swarm_mjcf.names import WALLS

BORDERLINE = 1e-4
"""Pairs whose surfaces are within this [m] of just touching are counted apart: float32 may tell them either way."""
_POINTS = 1 << 17
"""Agent rows looked at together: bounds the memory."""


def replay(trajectories: Trajectories, *, states: int | None = None, arena: float | int | None = None) -> Trajectories:
    """The same trajectories with contact fields from the recorded positions and radii, for `collision_report`.

    Contacts of row t are those of the `states` states from row t-1 (exclusive) to row t; what overlaps at row 0 already
    has its onset at the first state, as in an engine. Absent nodes touch nothing; one that enters at row t is looked at
    at that row alone.

    Args:
      states: states per control step; the recording's own `substeps` by default. 1 looks at the rows alone.
      arena: half-width of solid walls [m]; None for no walls.

    Raises:
      SpecError: `states` below 1 or `arena` not above 0.
    """
    k = _checked(trajectories, states, arena)
    t = trajectories
    (scenes, rows, nodes), (goals, obstacles, _) = t.mask.shape, t.counts
    touches, borderline = touching_pairs(t, states=k, arena=arena)
    first, both = goals + obstacles, touches.kind == BY_AGENT
    length = (rows - 1) * k + 1

    def tally(hits: Touches, node: np.ndarray, track: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States at which a node touches, and onsets, each track of a node for itself; both (S, T, V)."""

        def per_row(keys: np.ndarray) -> np.ndarray:  # keys: (owner, state) as one number
            owner, state = np.divmod(keys, length)
            cells = (owner // nodes * rows + (state - 1) // k + 1) * nodes + owner % nodes
            return np.bincount(cells, minlength=scenes * rows * nodes).reshape(scenes, rows, nodes).astype(np.int16)

        owner, tracks = hits.scene * nodes + node, int(track.max(initial=0)) + 1
        keys = np.unique((owner * tracks + track) * length + hits.state)
        onsets = keys[np.diff(keys, prepend=-2) != 1]  # state 0 is nobody's, so tracks never join
        states = np.unique(owner * length + hits.state)
        return per_row(states), per_row(onsets // length // tracks * length + onsets % length)

    pairs = touches.take(both)
    agents = Touches.concatenate([pairs, dataclasses.replace(pairs, agent=pairs.partner, partner=pairs.agent)])
    agent_contact, agent_events = tally(agents, first + agents.agent, np.zeros(len(agents), np.int64))
    solid_contact, solid_events = (np.zeros((scenes, rows, nodes), np.int16) for _ in range(2))
    for kind in (BY_OBSTACLE, BY_WALL):
        hits = touches.take(touches.kind == kind)
        contact, events = tally(hits, first + hits.agent, hits.partner if kind == BY_OBSTACLE else 0 * hits.partner)
        solid_contact, solid_events = solid_contact + contact, solid_events + events
    depth = np.zeros((scenes, rows, nodes), np.float32)
    for hits in (agents, touches.take(~both)):
        np.maximum.at(depth, (hits.scene, (hits.state - 1) // k + 1, first + hits.agent), hits.depth)
    about = {"states": k, "arena": arena, "borderline": borderline}
    return dataclasses.replace(
        t,
        agent_contact=agent_contact,
        solid_contact=solid_contact,
        agent_events=agent_events,
        solid_events=solid_events,
        depth=depth,
        saturated=np.zeros((scenes, rows), np.int16),
        provenance=t.provenance | {"replay": about},
    )


def touching_pairs(
    trajectories: Trajectories, *, states: int | None = None, arena: float | int | None = None
) -> tuple[Touches, int]:
    """Every pair at every state at which it touches, and how many pair-states are borderline. See `replay`."""
    k = _checked(trajectories, states, arena)
    parts, borderline = [Touches.concatenate([])], 0
    chunk = max(1, _POINTS // max(1, trajectories.mask[0].size))
    for start in range(0, len(trajectories), chunk):
        for part, near in _pairs_of(trajectories.take(slice(start, start + chunk)), k, arena):
            parts.append(dataclasses.replace(part, scene=part.scene + start))
            borderline += near
    return Touches.concatenate(parts), borderline


def _checked(t: Trajectories, states: int | None, arena: float | int | None) -> int:
    if states is not None and states < 1:
        raise SpecError("states", states, "at least 1 state per control step")
    if arena is not None and not arena > 0:
        raise SpecError("arena", arena, "None, or a half-width above 0 [m]")
    return t.substeps if states is None else states


@dataclasses.dataclass(frozen=True)
class _Motion:
    """Nodes of one kind over all control steps: at both ends (S, T-1, n, 2), and since when they are there."""

    x0: np.ndarray
    x1: np.ndarray
    v0: np.ndarray
    v1: np.ndarray
    here: np.ndarray
    """Present at the end of the step."""
    late: np.ndarray
    """Not yet present at its beginning: only the end is looked at."""
    radius: np.ndarray
    """(S, n)"""

    @classmethod
    def of(cls, t: Trajectories, kind: int) -> "_Motion":
        nodes = np.flatnonzero(t.kind[0] == kind)
        position, velocity = (x[:, :, nodes].astype(np.float64) for x in (t.position, t.velocity))
        mask = t.mask[:, :, nodes]
        late = ~mask[:, :-1, :, None]
        return cls(
            x0=np.where(late, position[:, 1:], position[:, :-1]),
            x1=position[:, 1:],
            v0=np.where(late, velocity[:, 1:], velocity[:, :-1]),
            v1=velocity[:, 1:],
            here=mask[:, 1:],
            late=late[..., 0],
            radius=t.radius[:, nodes].astype(np.float64),
        )


def _pairs_of(t: Trajectories, k: int, arena: float | int | None) -> Iterator[tuple[Touches, int]]:
    agents, obstacles = _Motion.of(t, AGENT), _Motion.of(t, OBSTACLE)
    scene, step, i, j = _close_agents(agents)
    yield _looked_at(agents, agents, scene, step, i, j, k=k, kind=BY_AGENT)
    for number in range(obstacles.here.shape[2]):
        scene, step, i = np.nonzero(agents.here & obstacles.here[:, :, number, None])
        yield _looked_at(agents, obstacles, scene, step, i, np.full_like(i, number), k=k, kind=BY_OBSTACLE)
    if arena is not None:
        for side in range(len(WALLS)):
            yield _at_wall(agents, side, float(arena), k)


def _close_agents(agents: _Motion) -> tuple[np.ndarray, ...]:
    """(scene, step, i, j), i < j, of all agents that may come to touch during a step: a superset, found by one tree.

    During a step an agent stays within half its way of its middle place. A third coordinate keeps steps apart.
    """
    scene, step, agent = np.nonzero(agents.here)
    if len(scene) < 2:
        return (np.zeros(0, np.int64),) * 4
    x0, x1 = agents.x0[scene, step, agent], agents.x1[scene, step, agent]
    way = np.hypot(*(x1 - x0).T).max()
    reach = 2 * float(agents.radius.max()) + way + BORDERLINE
    points = np.column_stack([(x0 + x1) / 2, 2 * reach * (scene * agents.here.shape[1] + step)])
    a, b = KDTree(points).query_pairs(reach, output_type="ndarray").reshape(-1, 2).T
    return scene[a], step[a], np.minimum(agent[a], agent[b]), np.maximum(agent[a], agent[b])


def _looked_at(
    one: _Motion,
    other: _Motion,
    scene: np.ndarray,
    step: np.ndarray,
    i: np.ndarray,
    j: np.ndarray,
    *,
    k: int,
    kind: int,
) -> tuple[Touches, int]:
    """The states of these pairs at which they touch, and the number of borderline ones."""
    apart0, apart1 = (
        other.x0[scene, step, j] - one.x0[scene, step, i],
        other.x1[scene, step, j] - one.x1[scene, step, i],
    )
    reach = one.radius[scene, i] + other.radius[scene, j]
    # Straight relative motion: the closest approach tells at once which pairs never touch in the step.
    change = apart1 - apart0
    square = (change**2).sum(axis=1)
    closest = np.clip(-(apart0 * change).sum(axis=1) / np.where(square > 0, square, 1), 0, 1)[:, None]
    near = np.hypot(*(apart0 + closest * change).T) < reach + BORDERLINE
    scene, step, i, j, apart0, apart1, reach = (x[near] for x in (scene, step, i, j, apart0, apart1, reach))

    late = one.late[scene, step, i] | other.late[scene, step, j]
    share = (np.arange(1, k + 1) / k)[None, :, None]
    apart = (1 - share) * apart0[:, None] + share * apart1[:, None]  # (P, k, 2)
    distance = np.hypot(apart[..., 0], apart[..., 1])
    depth = reach[:, None] - distance
    seen = ~late[:, None] | (share[..., 0] == 1)
    pair, state = np.nonzero((depth > 0) & seen)
    share = share[0, state]
    v = [
        (1 - share) * b.v0[scene[pair], step[pair], n[pair]] + share * b.v1[scene[pair], step[pair], n[pair]]
        for b, n in ((one, i), (other, j))
    ]
    relative, away, far = v[1] - v[0], apart[pair, state], distance[pair, state]
    touches = Touches(
        scene=scene[pair],
        state=step[pair] * k + state + 1,
        agent=i[pair],
        kind=np.full(len(pair), kind),
        partner=j[pair],
        depth=depth[pair, state],
        relative_speed=np.hypot(relative[:, 0], relative[:, 1]),
        closing_speed=-(relative * away).sum(axis=1) / np.where(far > 0, far, 1),
        impulse=np.full(len(pair), np.nan),
    )
    return touches, int(((np.abs(depth) < BORDERLINE) & seen).sum())


def _at_wall(agents: _Motion, side: int, arena: float, k: int) -> tuple[Touches, int]:
    """States at which an agent reaches over one border of the arena, and the number of borderline ones."""
    axis, sign = side % 2, 1 - 2 * (side // 2)
    share = np.arange(1, k + 1) / k
    scene, step, agent = np.nonzero(agents.here)
    radius = agents.radius[scene, agent]
    over0, over1 = (sign * x[scene, step, agent, axis] + radius - arena for x in (agents.x0, agents.x1))
    near = np.maximum(over0, over1) > -BORDERLINE
    scene, step, agent, over0, over1 = (x[near] for x in (scene, step, agent, over0, over1))
    over = (1 - share) * over0[:, None] + share * over1[:, None]
    seen = ~agents.late[scene, step, agent][:, None] | (share == 1)
    hit, state = np.nonzero((over > 0) & seen)
    velocity = [b[scene[hit], step[hit], agent[hit]] for b in (agents.v0, agents.v1)]
    velocity = (1 - share[state])[:, None] * velocity[0] + share[state][:, None] * velocity[1]
    touches = Touches(
        scene=scene[hit],
        state=step[hit] * k + state + 1,
        agent=agent[hit],
        kind=np.full(len(hit), BY_WALL),
        partner=np.full(len(hit), side),
        depth=over[hit, state],
        relative_speed=np.hypot(velocity[:, 0], velocity[:, 1]),
        closing_speed=sign * velocity[:, axis],
        impulse=np.full(len(hit), np.nan),
    )
    return touches, int(((np.abs(over) < BORDERLINE) & seen).sum())
