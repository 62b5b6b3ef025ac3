"""First states from which nothing that anybody does keeps two bodies apart: contacts that are no policy's fault."""

import jax
import numpy as np
from jaxtyping import Bool

from envs.dynamics import Kinematics
from repair.encounters import Bodies, encounters, length
from repair.network import situations_of
from repair.screen import Acted

TOLERANCE = 1e-4
"""By how much bodies have to overlap, whatever is done, to count as touching [m]: more than float32 positions round."""


def lost(acted: Acted, bodies: Bodies, kinematics: Kinematics) -> Bool[np.ndarray, " S"]:
    """Scenes that are lost in their first row: at some physics step two bodies touch wherever they can have come to.

    After n physics steps of h seconds, accelerations of at most a have taken a body at most a h^2 n (n + 1) / 2 [m]
    from where its velocity alone would have; the limit of the speed only lessens that (nothing is said of who begins
    above it: it is slowed down by more than a). Two bodies touch whatever they do if for some n, with a_i + a_j of the
    two (an obstacle has none),

        |p + v n h| + (a_i + a_j) h^2 n (n + 1) / 2 < R

    A proof, not a search: a scene that it does not call lost may be lost all the same.
    """
    nodes = np.asarray(acted.nodes, np.float64)[:, 0]
    e = encounters(situations_of(nodes, jax.tree.map(np.asarray, acted.graph)), bodies)
    here = np.asarray(acted.graph.present)[:, -acted.graph.counts[2] :]
    slow = np.linalg.norm(nodes[:, -here.shape[1] :, 2:], axis=-1) <= kinematics.max_speed + TOLERANCE
    others = np.concatenate([np.ones((len(nodes), acted.graph.counts[1]), bool), slow], axis=1)
    told = slow.reshape(-1, 1) & np.repeat(others, here.shape[1], axis=0)
    h = kinematics.dt / kinematics.substeps
    push = kinematics.max_acceleration * h * h * np.where(e.steers, 2.0, 1.0)
    found = np.zeros(e.present.shape, bool)
    for n in range(1, acted.touching_agent.shape[1] * kinematics.substeps + 1):
        reached = push * (n * (n + 1) / 2)
        if (reached >= e.reach).all():
            break
        found |= length(e.relative + e.velocity * (n * h)) + reached < e.reach - TOLERANCE
    return ((found & told & e.present).any(axis=1).reshape(here.shape) & here).any(axis=1)
