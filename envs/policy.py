"""What steers a swarm: experts, learned networks and users' functions are the same kind of function."""

from collections.abc import Callable

from envs.record import Array

Policy = Callable[..., Array]
"""`(state, params, key) -> acceleration (S, N, 2) [m/s^2]`; `params` may be anything, one key per scene."""
