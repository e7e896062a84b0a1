"""The learner: the part of a run that owns parameters, optimizers and normalizers."""

import torch

from learner.state import LearnerState
from learner.update import update


def resolve_device(name):
    """`cuda` or `cpu` for `auto`, by what this process sees; else the name."""
    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name


class Learner:
    """Holds the state between updates; each call is a pure function of it and the arguments."""

    def __init__(self, config, saved=None):
        """config: the run's `orchestrator.config.Config`; saved: what `saved()` gave, to continue from."""
        torch.set_num_threads(config.learner_threads)
        self._state = LearnerState(config, config.seed, resolve_device(config.device))
        if saved is not None:
            self._state.load_state_dict(saved)

    def policy(self):
        """The policy to act with now."""
        return self._state.snapshot()

    def update(self, *chunks):
        """(policy after one more update, metrics)."""
        self._state, metrics = update(self._state, chunks)
        return self._state.snapshot(), metrics

    def saved(self):
        """Plain tensors and numbers for a checkpoint, off the GPU: who writes it may have none."""
        return _on_cpu(self._state.state_dict())


def _on_cpu(value):
    """Nested dicts, lists and tuples with every tensor in the computer's own memory."""
    if isinstance(value, torch.Tensor):
        return value.cpu()
    if isinstance(value, dict):
        return {key: _on_cpu(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_on_cpu(item) for item in value)
    return value
