"""Does the physics of the descent at arrival know what a push does there? For runs with `arrival.weight`.

    python -m benchmarks.foresight RUN [--tasks 30] [--pushes 255] [--seed 0] [--json] [key=value ...]

The newest checkpoint's policy plays tasks of the run's grid with exploration noise. Every task is played again with
one more draw of that noise added to the actions of one step; what `arrival.physics` is, the network of
`learner.dynamics` or simulated derivatives, follows the same pushes along the trajectory that was observed, through the
policy's corrections, as `learner.arrival` does. Printed, for pushes k steps before the nearest approach: how far they
moved the root there (mm, root mean square), and the correlation of what the simulator and that physics say they changed
at that step: of the root's place, the key bodies and the joints' rotations, all less the target's. 1: the descent's
gradient is that of physics; 0: it is noise.
"""

import json
import math

import numpy as np
import torch

from benchmarks.limits import NEVER, command_line, opened
from learner.encoding import split
from learner.state import LearnerState
from motion.errors import InputError
from orchestrator import saved
from orchestrator.tasks import TaskGrid
from workers.derivatives import TANGENT, Derivatives
from workers.environment import Environment, new_observations
from workers.inference import PolicyNetwork
from workers.kinematics import NUM_DOF
from workers.library import build_library
from workers.observation import JOINT_AXES, KEY_PLACES
from workers.reward import KP, RP, Q

STEPS = 16  # of an episode that are played
# of p_tar, which has the root's place (3) where p_t has its height
PARTS = {
    "root": slice(0, 3),
    "keys": slice(KEY_PLACES.start + 2, KEY_PLACES.stop + 2),
    "joints": slice(JOINT_AXES.start + 2, JOINT_AXES.stop + 2),
}


def main():
    """Measure and print."""
    parser, options = command_line(
        __doc__, tasks=(30, 1, None), pushes=(255, 1, "of every task, each at a step drawn by chance")
    )  # fmt: skip
    torch.set_num_threads(1)
    config, _, machine = opened(parser, options)
    content, _ = saved.load_latest(options.run, config)
    learned = config.arrival.physics == "learned"
    if not config.arrival.weight or (learned and not content["parts"][0].get("dynamics")):
        parser.error(f"{options.run}: trained without the descent at arrival; train with arrival.weight=0.05")
    state = LearnerState(config, config.seed)
    try:
        state.load_state_dict(content["parts"][0])
    except InputError as error:  # physics that another version learned
        parser.error(str(error))
    policy, cuts = content["policies"][-1], content["parts"][1].tightenings
    found = measure(config, state, policy, cuts, build_library(machine), options.tasks, options.pushes, options.seed)
    print("  k  pushes      mm   root   keys  joints")
    for k, row in found.items():
        print(f"{k:3d} {row['pushes']:7d} {row['mm']:7.2f} {row['root']:6.2f} {row['keys']:6.2f} {row['joints']:7.2f}")
    if options.json:
        print(json.dumps(found))


def measure(config, state, policy, cuts, library, tasks, pushes, seed):
    """{k: {pushes, mm, root, keys, joints}}; see the module's docstring.

    state: `LearnerState` of the run. policy: `workers.types.Policy` that acts, the learner's of now. cuts: how many
    tightenings the run has had, on which exploration noise depends. tasks: how many. pushes: per task.
    """
    rng = np.random.default_rng(seed)
    grid = TaskGrid(library, config.evaluation)
    numbers = rng.choice(len(grid), size=min(tasks, len(grid)), replace=False)
    deviation = math.exp(float(policy.exploring_log_sigma(np.array([cuts]))[0]))
    follower = Follower(config, library, policy, pushes + 1)
    simulated = Differences(config, follower) if config.arrival.physics == "simulated" else None
    changed = {}
    for number in numbers:
        task = grid.tasks([number])[0]
        noise = np.broadcast_to(rng.normal(0.0, deviation, (STEPS, 1, NUM_DOF)), (STEPS, pushes + 1, NUM_DOF)).copy()
        observations, actions, nearest = follower.play(task, noise)
        when = rng.integers(nearest + 1, size=pushes)
        noise[when, 1 + np.arange(pushes)] += rng.normal(0.0, deviation, (pushes, NUM_DOF))
        pushed, _, _ = follower.play(task, noise)
        ends = relative(config, torch.as_tensor(pushed[nearest + 1]))
        true = ends[1:] - ends[:1]  # the first has no push
        more = noise[:, 1:] - noise[:, :1]
        if simulated:
            said = simulated.foreseen(state, observations[:, 0], actions[:, 0], more, nearest)
        else:
            said = foreseen(state, observations[:, 0], actions[:, 0], more, nearest)
        for k in range(nearest + 1):
            rows = nearest - when == k
            changed.setdefault(k, []).append((true[rows].numpy(), said[rows].numpy()))
    rows = {}
    for k in sorted(changed):
        true, said = (np.concatenate(parts) for parts in zip(*changed[k]))
        if len(true):
            rows[k] = {"pushes": len(true), "mm": 1000 * math.sqrt((true[:, :3] ** 2).sum(axis=1).mean())}
            rows[k] |= {name: correlation(true[:, part], said[:, part]) for name, part in PARTS.items()}
    return rows


class Follower:
    """Plays one task in N simulations that differ in their noise."""

    def __init__(self, config, library, policy, simulations):
        """policy: `workers.types.Policy`; its newest weights act, not their average."""
        self._env, self._n = Environment(config, library, simulations), simulations
        self._network = PolicyNetwork(policy, simulations)
        self._final = np.array(config.curriculum.floor)
        self.physics, self.poses = [], []  # of the first simulation, before every step of the last play and at its end

    @property
    def target(self):
        """(qpos (47,), qvel (37,)) of the task played last."""
        return self._env.target_qpos[0], self._env.target_qvel[0]

    def play(self, task, noise):
        """(observations (H + 1, N, 282), actions (H, N, 31), step of the first row's nearest approach), no end."""
        env, steps = self._env, len(noise)
        env.task[:] = task
        env.begin(np.arange(self._n))
        observations, actions = new_observations(steps + 1, self._n), np.empty(noise.shape, dtype=np.float32)
        left, self.physics, self.poses = np.empty(steps), [], []

        def keep():
            self.physics.append(env.physics[0].copy())
            self.poses.append((env.qpos[0].copy(), env.qvel[0].copy()))

        for t in range(steps):
            keep()
            actions[t] = self._network.mean(env.observe(observations[t])) + noise[t]
            env.step(actions[t], NEVER)
            left[t] = (env.deviations[0, [RP, KP, Q]] / self._final).max()
        env.observe(observations[steps])
        keep()
        return observations, actions, int(left.argmin())


class Differences:
    """What simulated derivatives foresee of the first simulation of a `Follower`'s last play."""

    def __init__(self, config, follower):
        self._config, self._follower, self._derivatives = config, follower, Derivatives(config, 1)

    @torch.no_grad()
    def foreseen(self, state, observations, actions, pushes, nearest):
        """As `foreseen` below, by derivatives of physics."""
        played, steps = self._follower, nearest + 1
        target = [np.tile(array, (steps, 1)) for array in played.target]
        of_all = torch.as_tensor(self._derivatives.of(np.array(played.physics[:steps]), actions[:steps], target[0]))
        after = [np.array(arrays) for arrays in zip(*played.poses[1 : steps + 1])]
        seen_by = torch.as_tensor(self._derivatives.observed(*after, *target))
        seen = torch.as_tensor(observations)
        tangent, followed = torch.zeros(TANGENT, pushes.shape[1]), seen[:1].expand(pushes.shape[1], -1)
        for t in range(steps):
            corrections = state.policy(state.observations(followed)) - state.policy(state.observations(seen[t : t + 1]))
            changed = corrections + torch.as_tensor(pushes[t], dtype=torch.float32)
            tangent = of_all[t, :, :TANGENT] @ tangent + of_all[t, :, TANGENT:] @ changed.T
            followed = seen[t + 1] + (seen_by[t] @ tangent).T
        return relative(self._config, followed) - relative(self._config, seen[nearest + 1 : nearest + 2])


@torch.no_grad()
def foreseen(state, observations, actions, pushes, nearest):
    """What the network says that pushes (H, P, 31) change in `relative` (P, 142) after step `nearest`.

    observations (H + 1, 282), actions (H, 31): what was seen without them; the network's own error along it is added,
    as in `learner.arrival`.
    """
    seen, acted = torch.as_tensor(observations), torch.as_tensor(actions)
    followed = seen[:1].expand(pushes.shape[1], -1)
    for t in range(nearest + 1):
        here = seen[t : t + 1]
        missing = seen[t + 1] - state.dynamics.step(here, acted[t : t + 1])
        corrections = state.policy(state.observations(followed)) - state.policy(state.observations(here))
        action = acted[t] + corrections + torch.as_tensor(pushes[t], dtype=torch.float32)
        followed = state.dynamics.step(followed, action) + missing
    return relative(state.config, followed) - relative(state.config, seen[nearest + 1 : nearest + 2])


def relative(config, observation):
    """p_tar (B, 142) of s_t (B, 282) less p_t but for the root's place, which is relative already."""
    pose, target = split(observation, config.observation.target == "difference")
    return torch.cat([target[:, :3], target[:, 3:] - pose[:, 1:]], dim=1)


def correlation(a, b):
    """Of all numbers of two arrays of the same shape, about zero."""
    return float((a * b).sum() / math.sqrt((a**2).sum() * (b**2).sum() + 1e-300))


if __name__ == "__main__":
    main()
