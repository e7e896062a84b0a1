"""Episodes played beside a chunk for the descent at arrival, with derivatives of physics along a few steps of each.

What `arrival.weight` learns from (`learner.followed_windows`). Their tasks are drawn as training's are;
they act as in the evaluation, with its noise, and go on past their arrival, so that they show whether the figure stays;
their windows are played again, the last steps without noise. Nobody else knows of them. A function of (policy,
thresholds, seed, environments, clock) and of nothing before: there is no state to keep.
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
from workers.types import FELL, Thresholds, Trials, Windows, concatenate_windows

# last steps of a window without noise, which the policy could hardly correct any more: it would hide the rest
QUIET = 3
FAR = 2.0  # m; whose root's place is farther off after a step is left to PPO
NEVER = Thresholds(0.0, 0.0, 0.0)  # no episode ends by arriving
_EPISODES = 2**40  # from here on their tasks are numbered, by the clock: those of training never get there
_DRAW = 2**20  # from this block on are numbers that say who plays and where windows end; noise has the first few


@njit(cache=True)
def drawn(seed, environment, clock, share):
    """Whether environments (N,) play such an episode beside the chunk that begins at `clock`: a share of them."""
    out = np.empty(len(environment), dtype=np.bool_)
    for i in range(len(environment)):
        out[i] = uniforms(seed, DERIVATIVES, environment[i], clock, _DRAW)[0] < share
    return out


@njit(cache=True)
def _last(seed, environment, clock, number, near):
    """(n,): one of the steps near (H, n) of each, all equally likely, for window `number`; -1 where there is none."""
    out = np.full(near.shape[1], -1, dtype=np.int64)
    for i in range(len(out)):
        steps = np.flatnonzero(near[:, i])
        if len(steps):
            out[i] = steps[int(uniforms(seed, DERIVATIVES, environment[i], clock, _DRAW + number)[1] * len(steps))]
    return out


def after_arrival(left, limits):
    """(H, n): whether an episode had arrived at an earlier step: what it does then is no longer its task.

    left: (H, n, 3), deviations after each step; limits: (n, 3).
    """
    arrived = (left < limits).all(axis=2)
    return arrived.cumsum(axis=0) > arrived


class Scouts:
    """Plays them for one worker; scratch memory only."""

    def __init__(self, config, library, num_envs, seed, threads):
        """config: `EnvConfig` and the curriculum's. num_envs: of the worker. seed: of the run."""
        self._config, self._seed = config, seed
        self._env = Environment(config, library, num_envs, threads)
        self._derivatives = Derivatives(config, threads)

    def play(self, policy, thresholds, environment, clock):
        """(`Windows`, `Trials`) of a policy beside the chunk that begins at `clock`; environment: (N,), indices in the
        run."""
        environment = environment[drawn(self._seed, environment, clock, self._config.arrival.share)]
        network, deviation = PolicyNetwork(policy, self._env.num_envs), np.float32(np.exp(policy.judge_log_sigma))
        left, physics, observation = self._play(network, deviation, thresholds, environment, clock)
        limits = self._limits(thresholds, len(environment))
        trials = Trials(environment, limits.astype(np.float32), observation, np.isfinite(left[:, :, 0]))
        near, made = left[:, :, 0] < FAR, []
        if self._config.arrival.ends is not None:
            near &= ~after_arrival(left, limits)
        for number in range(self._config.arrival.windows):
            last = _last(self._seed, environment, clock, number, near)
            made.append(self._window(network, deviation, trials, physics, last, clock))
        return concatenate_windows(made), trials

    def _window(self, network, deviation, trials, physics, last, clock):
        """`Windows` that end at steps last (n,) of the episodes of `Trials`; -1: none. physics: (H, n, nstate), before
        each of their steps."""
        rows = np.flatnonzero(last >= 0)
        environment, first = trials.environment[rows], last[rows] - self._config.arrival.steps + 1
        noise = [
            deviation * self._noise(environment, clock, np.maximum(first + k, 0))
            for k in range(self._config.arrival.steps)
        ]
        for unseen in noise[-QUIET:]:
            unseen[:] = 0.0
        begin = np.maximum(-first, 0)
        made = Windows(
            environment=environment,
            limits=trials.limits[rows],
            begin=begin,
            **self._last_steps(network, physics[np.maximum(first, 0), rows], rows, begin, noise),
        )
        fine = np.isfinite(made.by_action).all(axis=(1, 2, 3)) & np.isfinite(made.by_state).all(axis=(1, 2, 3))
        return made if fine.all() else made.take(np.flatnonzero(fine))

    def _limits(self, thresholds, n):
        """(n, 3): the thresholds of the tasks in the first n rows, `arrival.lead` tightenings on."""
        rows, curriculum = np.arange(n), self._config.curriculum
        limits = thresholds.of(self._env.groups(thresholds, rows))[:, :3]
        return np.maximum(limits * curriculum.factor**self._config.arrival.lead, curriculum.floor)

    def _play(self, network, deviation, thresholds, environment, clock):
        """(deviations after each of H steps of the first n rows (H, n, 3), infinite from a fall on; physics before;
        observations before and after the last (H + 1, n, 282))."""
        env, n, steps = self._env, len(environment), self._config.task.time_limit
        rows, index = np.arange(n), np.zeros(self._env.num_envs, dtype=np.int64)
        index[:n] = environment
        env.end[:] = 0  # nobody has failed: all tasks are new
        focus = np.full(env.num_envs, self._config.task.focus)
        env.plan(self._seed, index, np.full(env.num_envs, _EPISODES + clock), rows, focus, thresholds.shares)
        env.begin(rows)
        left, physics = np.empty((steps, n, 3)), np.empty((steps, n, env.physics.shape[1]))
        observation = new_observations(steps + 1, n)
        action = np.zeros((env.num_envs, NUM_DOF), dtype=np.float32)
        standing = np.ones(n, dtype=bool)
        for t in range(steps):
            mean = network.mean(env.observe(observation[t], rows))
            action[:n] = mean + deviation * self._noise(environment, clock, np.full(n, t))
            physics[t] = env.physics[:n]
            env.step(action, NEVER, rows)
            standing &= env.end[:n] != FELL
            left[t] = np.where(standing[:, None], env.deviations[:n][:, [RP, KP, Q]], np.inf)
        env.observe(observation[steps], rows)
        return left, physics, observation

    def _noise(self, environment, clock, step):
        """(n, 31) float32, standard normal, of environments (n,) at steps (n,) of their episodes."""
        noise = np.empty((len(environment), NUM_DOF))
        fill_normal(self._seed, DERIVATIVES, environment, (clock << 16) + step, noise)
        return noise.astype(np.float32)

    def _last_steps(self, network, physics, rows, begin, noise):
        """{name: array} of `Windows`, of the steps that follow on states (M, nstate) in rows (M,), with noise, (M, 31)
        of each step, from step begin (M,) of the window on."""
        env, steps, count = self._env, self._config.arrival.steps, len(rows)
        env.place(physics, rows)
        action = np.zeros((env.num_envs, NUM_DOF), dtype=np.float32)
        made = {
            name: np.zeros((count, *shape), dtype=np.float32)
            for name, shape in (
                ("observation", (steps + 1, OBSERVATION_SIZE)), ("mean", (steps, NUM_DOF)),
                ("by_action", (steps, TANGENT, NUM_DOF)), ("by_state", (steps - 1, TANGENT, TANGENT)),
                ("seen", (steps, OBSERVATION_SIZE, TANGENT)),
            )
        }  # fmt: skip
        env.observe(made["observation"][:, 0], rows)
        for k in range(steps):
            made["mean"][:, k] = network.mean(made["observation"][:, k])
            on = np.flatnonzero(begin <= k)
            acting, before = rows[on], env.physics[rows[on]]
            target = env.target_qpos[acting], env.target_qvel[acting]
            action[acting] = made["mean"][on, k] + noise[k][on]
            derivatives = self._derivatives.of(before, action[acting], target[0], by_state=k > 0)
            env.step(action, NEVER, acting)
            env.observe(made["observation"][:, k + 1], rows)
            made["by_action"][on, k] = derivatives[:, :, -NUM_DOF:]
            made["seen"][on, k] = self._derivatives.observed(env.qpos[acting], env.qvel[acting], *target)
            if k:
                made["by_state"][on, k - 1] = derivatives[:, :, :TANGENT]
        return made
