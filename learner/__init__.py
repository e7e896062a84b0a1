"""PPO and Self-Behavior Cloning: networks, losses, the pure `update`, checkpoints. Knows nothing of Ray."""
