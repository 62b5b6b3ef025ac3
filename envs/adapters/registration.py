"""`SwarmNet/Swarm-v0` for `gymnasium.make` and `gymnasium.make_vec`; importing this module registers it."""

import gymnasium

ID = "SwarmNet/Swarm-v0"


def register() -> None:
    """Tells Gymnasium about `SwarmNet/Swarm-v0`; a second call changes nothing."""
    if ID not in gymnasium.registry:
        gymnasium.register(
            ID,
            entry_point="envs.adapters.gym_single:make_single",
            vector_entry_point="envs.adapters.gym_vector:make_vector",
            order_enforce=True,
        )


register()
