"""Rollout: the humanoid's model, the batched transition environment, and `collect`. Start with `workers.types`."""
