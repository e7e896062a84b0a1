"""The environment as a `gymnasium.vector.VectorEnv`, for other libraries' learners. Needs gymnasium (extra `peers`).

Segue itself does not use it: `workers.rollout` collects the same steps with less copying.
"""

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from motion.state_machine import build_state_machine
from workers.environment import Environment, new_observations
from workers.kinematics import NUM_DOF
from workers.library import build_library
from workers.observation import OBSERVATION_SIZE
from workers.types import REACHED

ACTION_LIMIT = 10.0  # of the action space; at any scale in use beyond every joint's range


class TransitionVectorEnv(VectorEnv):
    """Transition tasks at fixed thresholds, `num_envs` at a time; who ends an episode begins the next by itself.

    Observations (num_envs, 282) and actions (num_envs, 31) float32 as in `workers.environment`, rewards (num_envs,)
    float64. A time-out terminates an episode as a fall does: it is a failure with a reward of its own (Eq. 9), so
    nothing is ever truncated. Tasks are a function of (seed, environment, episode), as in a run of Segue.

    At an episode's end, infos say by gymnasium's conventions whether the target was `reached`, whether the task had
    been `retained` after a failure, the episode's `steps` and its `return`. With SAME_STEP autoreset, the default,
    these stand in `infos["final_info"]` and the last observation in `infos["final_obs"]`; with NEXT_STEP, for libraries
    that know nothing else, in `infos` itself, and the step after an end only begins the next episode: its action has no
    effect, its reward is 0 and no physics is computed.
    """

    def __init__(
        self, config, thresholds, num_envs=None, threads=1, first=0, autoreset_mode=AutoresetMode.SAME_STEP
    ):  # fmt: skip
        """config: `orchestrator.config.Config`; thresholds: `Thresholds`; num_envs: default `config.num_envs`.

        threads: of physics. first: index in the whole run of the first of these environments.
        """
        if autoreset_mode not in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP):
            raise ValueError(f"autoreset_mode={autoreset_mode} must be SAME_STEP or NEXT_STEP")
        self.num_envs = num_envs or config.num_envs
        self.metadata = {"autoreset_mode": autoreset_mode, "render_modes": []}
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-ACTION_LIMIT, ACTION_LIMIT, (NUM_DOF,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        library = build_library(build_state_machine(config.motions))
        self._environment = Environment(config, library, self.num_envs, threads)
        self._thresholds, self._seed = thresholds, config.seed
        self._same_step = autoreset_mode == AutoresetMode.SAME_STEP
        self._index = np.arange(first, first + self.num_envs, dtype=np.int64)
        self._episode = np.full(self.num_envs, -1, dtype=np.int64)
        self._waiting = np.zeros(self.num_envs, dtype=np.bool_)  # to begin an episode at the next step

    def reset(self, *, seed=None, options=None):
        """(observations, {}) at the start of new episodes. A seed starts the sequence of tasks anew."""
        super().reset(seed=seed)
        if seed is not None:
            self._seed = seed
            self._episode[:] = -1
        self._environment.end[:] = 0
        self._waiting[:] = False
        self._begin(np.arange(self.num_envs))
        return self._environment.observe(new_observations(self.num_envs)), {}

    def step(self, actions):
        """(observations, rewards, terminations, truncations, infos) after one policy step of all environments."""
        env, waiting = self._environment, self._waiting
        going = np.flatnonzero(~waiting) if waiting.any() else None
        env.step(np.asarray(actions, dtype=np.float32), self._thresholds, going)
        rewards = np.where(waiting, 0.0, env.parts.sum(axis=1))
        ended = (env.end != 0) & ~waiting
        infos = self._infos(ended) if ended.any() else {}
        if self._same_step:
            self._begin(np.flatnonzero(ended))
        else:
            self._begin(np.flatnonzero(waiting))
            self._waiting = ended.copy()
        observations = env.observe(new_observations(self.num_envs))
        return observations, rewards, ended, np.zeros(self.num_envs, dtype=np.bool_), infos

    def _infos(self, ended):
        """What is to be said of the episodes of the rows `ended` (num_envs,), some of which are true."""
        env = self._environment
        numbers = {
            "reached": env.end == REACHED, "retained": env.retained,
            "steps": env.steps, "return": env.totals.sum(axis=1),
        }  # fmt: skip
        infos = {}
        for name, values in numbers.items():
            infos[name], infos[f"_{name}"] = np.where(ended, values, np.zeros_like(values)), ended.copy()
        if not self._same_step:
            return infos
        ids = np.flatnonzero(ended)
        final = np.full(self.num_envs, None, dtype=object)
        for i, row in zip(ids, env.observe(new_observations(len(ids)), ids)):
            final[i] = row
        return {
            "final_obs": final, "_final_obs": ended.copy(), "final_info": infos, "_final_info": ended.copy(),
        }  # fmt: skip

    def _begin(self, ids):
        """Begin the next episodes of rows ids."""
        self._environment.plan(self._seed, self._index, self._episode, ids)
        self._environment.begin(ids)
