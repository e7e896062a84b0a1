"""`collect`: one chunk of trajectories, a pure function of (worker state, policy, thresholds)."""

import numpy as np

from workers.environment import Environment, new_observations
from workers.inference import PolicyNetwork
from workers.kinematics import NQ, NUM_DOF, NV
from workers.noise import ActionNoise
from workers.types import Chunk, Outcomes, concatenate_outcomes, judging
from workers.windows import Scouts


class Rollout:
    """A worker's environments and scratch memory. `collect` leaves nothing behind that a later call depends on."""

    def __init__(self, config, library, num_envs, horizon, seed, threads=1):
        """config: `EnvConfig`; library: `MotionLibrary`; seed: of the run."""
        self._environment = Environment(config, library, num_envs, threads)
        self._horizon, self._seed, self._scouts = horizon, seed, None
        if config.arrival.weight:
            self._scouts = Scouts(config, library, num_envs, seed, threads)

    def initial_state(self, first):
        """The state before the first chunk, of the environments with indices first, first + 1, ... in the run."""
        env = self._environment
        index = np.arange(first, first + env.num_envs, dtype=np.int64)
        episode = np.full(env.num_envs, -1, dtype=np.int64)
        ids = np.arange(env.num_envs)
        env.end[:] = 0
        env.plan(self._seed, index, episode, ids)
        env.begin(ids)
        return env.save(index, episode, clock=0)

    def collect(self, state, policy, thresholds):
        """(Chunk, WorkerState) after `horizon` steps of the policy from `state`; see `workers.types`."""
        env, horizon, n = self._environment, self._horizon, self._environment.num_envs
        env.load(state)
        index, episode, clock = state.environment, state.episode.copy(), state.clock
        network = PolicyNetwork(policy, n)
        judged = judging(index, policy.judges)
        judges = np.flatnonzero(judged) if policy.average_weights else ()
        judge_network = PolicyNetwork(policy.averaged(), len(judges)) if len(judges) else None
        # judges draw all tasks alike, as the evaluation does
        focus = np.where(judged, 0.0, env.config.task.focus)
        noise = ActionNoise(policy, self._seed, index, clock)

        observation = new_observations(horizon, n)
        action = np.empty((horizon, n, NUM_DOF), dtype=np.float32)
        mean = np.empty_like(action)
        pd_target = np.empty_like(action)
        log_sigma = np.empty((horizon, n))
        reward = np.empty((horizon, n), dtype=np.float32)
        end = np.empty((horizon, n), dtype=np.int8)
        pose = np.empty((horizon, n, NQ + NV), dtype=np.float32)
        next_pose = np.empty_like(pose)
        everybody, nobody = np.arange(n), np.zeros(0, dtype=np.int64)
        final, ended = [env.observe(new_observations(0), nobody)], [outcomes(env, clock, index, nobody, thresholds)]
        for t in range(horizon):
            env.observe(observation[t])
            mean[t] = network.mean(observation[t])
            if judge_network:
                mean[t, judges] = judge_network.mean(observation[t, judges])
            cuts = tightenings(env, thresholds, everybody)
            log_sigma[t] = policy.exploring_log_sigma(cuts)
            action[t] = mean[t] + noise.next(log_sigma[t], policy.independent(cuts))
            pose[t, :, :NQ], pose[t, :, NQ:] = env.qpos, env.qvel
            env.step(action[t], thresholds)
            clock += 1
            next_pose[t, :, :NQ], next_pose[t, :, NQ:] = env.qpos, env.qvel
            pd_target[t] = env.pd_target
            reward[t] = env.parts.sum(axis=1)
            end[t] = env.end
            ids = np.flatnonzero(env.end)
            if len(ids):
                final.append(env.observe(new_observations(len(ids)), ids))
                ended.append(outcomes(env, clock, index, ids, thresholds))
                env.plan(self._seed, index, episode, ids, focus, thresholds.shares)
                env.begin(ids)
        windows = trials = None
        if self._scouts and policy.version >= env.config.arrival.after:
            windows, trials = self._scouts.play(policy, thresholds, index, state.clock)
        chunk = Chunk(
            environment=index.copy(),
            observation=observation,
            action=action,
            mean=mean,
            reward=reward,
            end=end,
            last_observation=env.observe(new_observations(n)),
            final_observation=np.concatenate(final),
            pose=pose,
            next_pose=next_pose,
            pd_target=pd_target,
            outcomes=concatenate_outcomes(ended),
            version=policy.version,
            log_sigma=log_sigma,
            windows=windows,
            trials=trials,
        )
        return chunk, env.save(index, episode, clock)


def tightenings(env, thresholds, ids):
    """(N,) int64, how often the thresholds of the tasks in rows ids of an environment were cut."""
    return thresholds.of(env.groups(thresholds, ids))[:, 4].astype(np.int64)


def outcomes(env, clock, index, ids, thresholds):
    """The `Outcomes` of rows ids of an environment, whose episodes have just ended under `Thresholds`."""
    return Outcomes(
        clock=np.full(len(ids), clock, dtype=np.int64),
        environment=index[ids],
        task=env.task[ids],
        retained=env.retained[ids],
        end=env.end[ids],
        fell_on=env.fell_on[ids],
        tightenings=tightenings(env, thresholds, ids),
        steps=env.steps[ids],
        trembles=env.trembles[ids],
        parts=env.totals[ids],
        deviations=env.deviations[ids],
    )
