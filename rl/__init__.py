"""How does the law improve? Actor-critic on a SwarmNet, PPO and freezing; nothing is here yet."""
