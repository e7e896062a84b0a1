"""Episodes played beside a chunk for the descent at arrival, with derivatives of physics before their nearest approach.

What `arrival.physics=simulated` learns from (`learner.simulated_windows`). These episodes act as in the evaluation,
with its noise, and go on past their arrival, so that they show how near the figure comes; nobody else knows of them. A
function of (policy, thresholds, seed, environments, clock) and of nothing before: there is no state to keep.
"""

import numpy as np
from numba import njit

from workers.counter_random import DERIVATIVES, fill_normal, uniforms
from workers.derivatives import TANGENT, Derivatives
from workers.environment import Environment, new_observations
from workers.inference import PolicyNetwork
from workers.kinematics import NUM_DOF
from workers.observation import OBSERVATION_SIZE
from workers.reward import KP, RP, Q
from workers.types import FELL, Thresholds, Windows

NEAR = 4.0  # thresholds; who came no nearer is left to PPO
_NEVER = Thresholds(0.0, 0.0, 0.0)  # no episode ends by arriving
_EPISODES = 2**40  # from here on their tasks are numbered, by the clock: those of training never get there
_DRAW = 2**20  # the block of the number that says who plays; noise has the first few


@njit(cache=True)
def drawn(seed, environment, clock, share):
    """Whether environments (N,) play such an episode beside the chunk that begins at `clock`: a share of them."""
    out = np.empty(len(environment), dtype=np.bool_)
    for i in range(len(environment)):
        out[i] = uniforms(seed, DERIVATIVES, environment[i], clock, _DRAW)[0] < share
    return out


class Scouts:
    """Plays them for one worker; scratch memory only."""

    def __init__(self, config, library, num_envs, seed, threads):
        """config: `EnvConfig` and the curriculum's. num_envs: of the worker. seed: of the run."""
        self._config, self._library, self._seed = config, library, seed
        self._env = Environment(config, library, num_envs, threads)
        self._derivatives = Derivatives(config, threads)

    def windows(self, policy, thresholds, environment, clock):
        """`Windows` of a policy beside the chunk that begins at `clock`; environment: (N,), indices in the run."""
        config, steps = self._config, self._config.arrival.steps
        environment = environment[drawn(self._seed, environment, clock, config.arrival.share)]
        played = self._play(policy, environment, clock)
        limits = self._limits(thresholds, len(environment))
        with np.errstate(invalid="ignore"):
            ratio = (played["left"] / limits).max(axis=2)
        first = ratio.argmin(axis=0) - steps + 1
        rows = np.flatnonzero((ratio.min(axis=0, initial=np.inf) < NEAR) & (first >= 0))
        at = [(first[rows] + k, rows) for k in range(steps + 1)]
        target = [array[rows] for array in (self._env.target_qpos, self._env.target_qvel)]
        parts = [
            self._derivatives.of(played["physics"][now], played["action"][now], target[0], by_state=k > 0)
            for k, now in enumerate(at[:-1])
        ]
        made = Windows(
            environment=environment[rows],
            limits=limits[rows].astype(np.float32),
            observation=_stack([played["observation"][now] for now in at], len(rows), OBSERVATION_SIZE),
            mean=_stack([played["mean"][now] for now in at[:-1]], len(rows), NUM_DOF),
            by_action=_stack([part[:, :, -NUM_DOF:] for part in parts], len(rows), TANGENT, NUM_DOF),
            by_state=_stack([part[:, :, :TANGENT] for part in parts[1:]], len(rows), TANGENT, TANGENT),
            seen=_stack(
                [self._derivatives.observed(played["qpos"][now], played["qvel"][now], *target) for now in at[1:]],
                len(rows), OBSERVATION_SIZE, TANGENT,
            ),
        )  # fmt: skip
        fine = np.isfinite(made.by_action).all(axis=(1, 2, 3)) & np.isfinite(made.by_state).all(axis=(1, 2, 3))
        return made if fine.all() else made.take(np.flatnonzero(fine))

    def _limits(self, thresholds, n):
        """(n, 3): the thresholds of the tasks in the first n rows, `arrival.lead` tightenings on."""
        rows, curriculum = np.arange(n), self._config.curriculum
        limits = thresholds.of(self._env.groups(thresholds, rows))[:, :3]
        return np.maximum(limits * curriculum.factor**self._config.arrival.lead, curriculum.floor)

    def _play(self, policy, environment, clock):
        """{name: what the first n rows did in H steps}: left (H, n, 3), infinite from a fall on; action and mean (H, n,
        31); observation, physics, qpos and qvel (H + 1, n, ...), before each step and at the end."""
        env, n, steps = self._env, len(environment), self._config.task.time_limit
        rows, index = np.arange(n), np.zeros(self._env.num_envs, dtype=np.int64)
        index[:n] = environment
        env.end[:] = 0  # nobody has failed: all tasks are new
        env.plan(self._seed, index, np.full(env.num_envs, _EPISODES + clock), rows)
        env.begin(rows)
        network, deviation = PolicyNetwork(policy, env.num_envs), np.exp(policy.judge_log_sigma)
        kept = {name: [] for name in ("left", "action", "mean", "observation", "physics", "qpos", "qvel")}
        noise, action = np.empty((n, NUM_DOF)), np.zeros((env.num_envs, NUM_DOF), dtype=np.float32)
        standing = np.ones(n, dtype=bool)
        for t in range(steps):
            seen = env.observe(new_observations(n), rows)
            mean = network.mean(seen).copy()
            fill_normal(self._seed, DERIVATIVES, environment, np.full(n, (clock << 16) + t), noise)
            action[:n] = mean + np.float32(deviation) * noise.astype(np.float32)
            before = {"observation": seen, "mean": mean, "action": action[:n], "physics": env.physics[:n]}
            for name, value in {**before, "qpos": env.qpos[:n], "qvel": env.qvel[:n]}.items():
                kept[name].append(value.copy())
            env.step(action, _NEVER, rows)
            standing &= env.end[:n] != FELL
            kept["left"].append(np.where(standing[:, None], env.deviations[:n][:, [RP, KP, Q]], np.inf))
        last = {"observation": env.observe(new_observations(n), rows), "qpos": env.qpos[:n], "qvel": env.qvel[:n]}
        for name, value in last.items():
            kept[name].append(value.copy())
        return {name: np.array(values) for name, values in kept.items()}


def _stack(parts, count, *shape):
    """(count, len(parts), *shape) float32."""
    if not parts:
        return np.empty((count, 0, *shape), dtype=np.float32)
    return np.ascontiguousarray(np.stack(parts, axis=1), dtype=np.float32)
