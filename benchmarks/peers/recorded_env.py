"""A Gymnasium `VectorEnv` that records its steps and ends a run from within."""

import numpy as np
from gymnasium.vector import AutoresetMode, VectorWrapper

from benchmarks.peers.record import Writer


class Enough(Exception):
    """The budget is used up: raised between two iterations, out of the library's own loop."""


class Recorded(VectorWrapper):
    """A `TransitionVectorEnv` that records its steps. Steps that only begin an episode are no samples.

    An iteration has at least `batch` of this process's samples, the rule by which every library here collects; its
    learning ends when the next one's first step is asked for. There `enough()` is asked whether to raise `Enough`.
    """

    def __init__(self, env, path, batch, enough=lambda: False):
        super().__init__(env)
        self._writer, self._batch, self._enough = Writer(path), batch, enough
        self._next_step = env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
        self._waiting, self._collected = np.zeros(env.num_envs, dtype=bool), 0

    def step(self, actions):
        begins = self._collected == 0 or self._collected >= self._batch
        if begins:
            self._collected = 0
            self._writer.write(0, 0, 0, True)
            if self._enough():
                raise Enough
        result = self.env.step(actions)
        terminated, infos = result[2], result[4]
        samples = self.num_envs - int(self._waiting.sum())
        if self._next_step:
            self._waiting = terminated.copy()
        ended = reached = 0
        if infos:
            episodes = infos if self._next_step else infos["final_info"]
            fresh = terminated & ~episodes["retained"]
            ended, reached = int(fresh.sum()), int((fresh & episodes["reached"]).sum())
        self._collected += samples
        self._writer.write(samples, ended, reached, False)
        return result
