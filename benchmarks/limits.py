"""How near to its target physics lets the figure come: tasks of a run's grid, each motion improved by itself.

    python -m benchmarks.limits RUN [--tasks 12] [--rounds 40] [--simulations 384] [--steps 26] [--seed 0] [--json]

A policy that misses a threshold leaves open whether any motion meets it. Here the newest checkpoint's policy plays
tasks drawn from its grid, without noise, and what it does is improved task by task: an offset for every step and joint
is added to its actions, and a round tries random offsets, fits by least squares how the pose at arrival depends on
them, and takes the best of several Gauss-Newton steps towards the target. Printed for each task is the largest of
d^rp, d^kp, d^q over its final accuracy at the nearest step before a fall, of the policy and of the improved motion: at
1 or below the task is reached at the final accuracy (section 4). That shows what physics allows to one motion, known in
advance and without noise; not that a policy can do it, nor, where it is above 1, that nothing can.
"""

import argparse
import json
import math
from dataclasses import replace

import numpy as np
from numba import njit

from motion import skeleton
from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator.evaluation.subject import load_newest
from orchestrator.folder import config_path
from orchestrator.settings import load
from orchestrator.tasks import TaskGrid
from workers.environment import Environment, new_observations
from workers.inference import PolicyNetwork
from workers.kinematics import (
    JOINT_QPOS,
    JOINT_SIZE,
    NUM_DOF,
    NUM_JOINTS,
    conjugate,
    logarithm,
    multiply,
    quaternion_at,
)  # fmt: skip
from workers.library import build_library
from workers.reward import KP, RP, Q
from workers.types import FELL
from workers.windows import NEVER

_KEYS = skeleton.KEY_BODIES
_WEIGHTS = skeleton.JOINT_WEIGHTS
RESIDUALS = 3 + 3 * len(_KEYS) + NUM_DOF
# what makes the squares of root, key bodies and joints count alike where each deviation is spread evenly
_BALANCE = np.repeat([1.0, math.sqrt(len(_KEYS)), math.sqrt(NUM_DOF)], [3, 3 * len(_KEYS), NUM_DOF])
_RIDGES, _DAMPINGS = (0.01, 0.1, 1.0), (1e-3, 1e-2, 1e-1)  # in units of the mean eigenvalue
_LENGTHS = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4)  # of a Gauss-Newton step
_GOOD_ENOUGH = 0.9  # of the final accuracy: the search ends


def main():
    """Measure and print."""
    search, drawn, rng, options = prepare(__doc__)
    found = []
    for label, task in drawn:
        figures = search.improve(task, options.rounds, rng)
        print(
            f"{label}: policy {figures['policy']:.2f}, improved {figures['improved']:.2f} of the final accuracy at "
            f"step {figures['step']}, offsets of {figures['offset']:.3f} rad, {figures['rounds']} rounds",
            flush=True,
        )
        found.append({"task": task.tolist(), "label": label, **figures})
    ratios = np.array([[item["policy"], item["improved"]] for item in found])
    reached = (ratios <= 1).sum(axis=0)
    middle = np.median(ratios, axis=0)
    print(
        f"within the final accuracy: policy {reached[0]}, improved {reached[1]} of {len(found)}; median of the ratios "
        f"{middle[0]:.2f} and {middle[1]:.2f}, largest {ratios[:, 0].max():.2f} and {ratios[:, 1].max():.2f}"
    )
    if options.json:
        print(json.dumps(found))


def prepare(description):
    """(Search, [(label, task (4,))] drawn from the grid, random numbers for the rest, options) of the command line."""
    parser, options = command_line(
        description,
        tasks=(12, 1, None),
        rounds=(40, 0, "at most, per task"),
        simulations=(384, 2, "side by side"),
        steps=(26, 1, "policy steps that a motion may take"),
    )
    config, policy, machine = opened(parser, options)
    library, rng = build_library(machine), np.random.default_rng(options.seed)
    grid, drawn = TaskGrid(library, replace(config.evaluation, max_tasks=0)), []
    for number in rng.choice(len(grid), size=min(options.tasks, len(grid)), replace=False):
        task = grid.tasks([number])[0]
        source, moment, target, turn = task
        source, target = machine.states[int(source)].name, machine.states[int(target)].name
        drawn.append((f"{source} at {moment:.2f} s to {target}, {math.degrees(turn):.0f} degrees", task))
    return Search(config, library, policy, options.simulations, options.steps), drawn, rng, options


def command_line(description, **counts):
    """(parser, options) of what is measured of a run; counts: {option: (default, least, help)}."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run's folder")
    for name, (default, _, meaning) in counts.items():
        parser.add_argument(f"--{name}", type=int, default=default, help=meaning)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print one last line with every figure")
    parser.add_argument("overrides", nargs="*", help="key=value")
    options = parser.parse_intermixed_args()
    for name, (_, least, _) in counts.items():
        if getattr(options, name) < least:
            parser.error(f"--{name}: must be at least {least}")
    return parser, options


def opened(parser, options):
    """(config, policy of the newest checkpoint, state machine) of a command line's `run` and `overrides`."""
    try:
        config = load(config_path(options.run), options.overrides)
        return config, load_newest(options.run, config).policy, build_state_machine(config.motions)
    except InputError as error:
        parser.error(str(error))


class Search:
    """Plays one task in N simulations that differ in the offsets added to the policy's actions."""

    def __init__(self, config, library, policy, simulations, steps):
        """policy: `workers.types.Policy`, whose mean acts. simulations: N. steps: H, policy steps of a motion.

        final: (3,), the final accuracy of d^rp, d^kp, d^q. noise: deviation of the evaluation's actions.
        """
        self._env, self._network = Environment(config, library, simulations), PolicyNetwork(policy, simulations)
        self.simulations, self.steps, self._scale = simulations, steps, config.action.scale
        self.final = np.array(config.curriculum.floor)
        self.noise = math.exp(config.evaluation.log_sigma) / config.action.scale  # in units of the network's output

    def play(self, task, offsets, at=None, actions=None):
        """(ratios (n, H), residuals (n, RESIDUALS) after step `at` or None) of a task (4,) with offsets (n, H, 31).

        offsets: in units of the network's output; n <= N. actions: (H, 31), what they are added to instead of the
        policy's mean where each simulation is. A ratio is the largest of d^rp, d^kp, d^q over its final accuracy after
        a step, infinite from a fall on. What acted stays in `acted` (n, H, 31) until the next call.
        """
        env, n = self._env, len(offsets)
        rows = np.arange(n)
        env.task[:n] = task
        env.begin(rows)
        ratios, standing, residuals = np.full((n, self.steps), np.inf), np.ones(n, dtype=bool), None
        action = np.zeros((env.num_envs, NUM_DOF), dtype=np.float32)
        self.acted = np.empty((n, self.steps, NUM_DOF), dtype=np.float32)
        for t in range(self.steps):
            mean = self._network.mean(env.observe(new_observations(n), rows)) if actions is None else actions[t]
            self.acted[:, t] = action[:n] = mean + offsets[:, t]
            env.step(action, NEVER, rows)
            standing &= env.end[:n] != FELL
            ratios[standing, t] = (env.deviations[:n][standing][:, [RP, KP, Q]] / self.final).max(axis=1)
            if t == at:
                residuals = self.residuals(n)
        return ratios, residuals

    def residuals(self, n):
        """What is left to the target in the first n simulations, (n, RESIDUALS): see `_residuals`."""
        env, out = self._env, np.empty((n, RESIDUALS))
        _residuals(env.qpos[:n], env.bodies[:n], env.target_qpos[:n], env.target_bodies[:n], self.final, out)
        return out

    def improve(self, task, rounds, rng):
        """{policy, improved: ratios at the nearest step; step: that of the improved motion, from 1; offset: root mean
        square of its offsets, rad; rounds: how many it took; offsets: (H, 31), in units of the network's output}."""
        best = np.zeros((self.steps, NUM_DOF))
        ratio, at = nearest(self.play(task, best[None])[0])[1:]
        first, sigma, done = ratio, 0.05, 0
        while done < rounds and ratio > _GOOD_ENOUGH:
            done += 1
            found = self._round(task, best, at, sigma, rng)
            if found[1] < ratio:
                best, ratio, at = found
            else:
                sigma *= 0.7
        size = self._scale * math.sqrt((best[: at + 1] ** 2).mean())
        return {
            "policy": float(first), "improved": float(ratio), "step": at + 1, "offset": size, "rounds": done,
            "offsets": best.tolist(),
        }  # fmt: skip

    def _round(self, task, best, at, sigma, rng):
        """(offsets (H, 31), ratio, step) of the best of one round's tries around `best`, which is nearest at `at`."""
        tried = rng.normal(0.0, sigma, (self.simulations, self.steps, NUM_DOF))
        tried[:, at + 1 :] = 0.0
        tried[0] = 0.0
        ratios, residuals = self.play(task, best + tried, at)
        i, ratio, step = nearest(ratios)
        found = best + tried[i], ratio, step
        standing = np.isfinite(ratios[:, at])
        if not standing[0] or standing.sum() < 2:
            return found
        x = tried[standing, : at + 1].reshape(standing.sum(), -1)
        residuals = residuals * _BALANCE
        steps = newton_steps(x, residuals[standing] - residuals[0], residuals[0])
        guesses = np.zeros((len(steps), self.steps, NUM_DOF))
        guesses[:, : at + 1] = steps.reshape(len(steps), at + 1, NUM_DOF)
        for some in np.array_split(best + guesses, -(-len(guesses) // self.simulations)):
            i, ratio, step = nearest(self.play(task, some)[0])
            if ratio < found[1]:
                found = some[i], ratio, step
        return found


def newton_steps(x, y, residual):
    """Steps (k, D) that should take a residual (R,) to zero, if the changes x (M, D) of what it depends on changed it
    by y (M, R): Gauss-Newton with a ridge regression for the Jacobian, at several ridges, dampings and lengths."""
    kernel, found = x @ x.T, []
    for ridge in _RIDGES:
        jacobian = np.linalg.solve(_damped(kernel, ridge), y).T @ x
        square = jacobian @ jacobian.T
        for damping in _DAMPINGS:
            step = -jacobian.T @ np.linalg.solve(_damped(square, damping), residual)
            found += [length * step for length in _LENGTHS]
    return np.array(found)


def _damped(square, share):
    added = share * np.trace(square) / len(square) + 1e-12
    return square + added * np.eye(len(square))


def nearest(ratios):
    """(row, ratio, step) of the smallest of ratios (n, H)."""
    row, step = np.unravel_index(ratios.argmin(), ratios.shape)
    return int(row), ratios[row, step], int(step)


@njit(cache=True)
def _residuals(qpos, bodies, target_qpos, target_bodies, final, out):
    """Differences from the target, each in units in which its deviation's final accuracy is 1, into out (n, RESIDUALS).

    Root position 3: their norm is d^rp. Key bodies 18: the sum of the six norms is d^kp. Joint rotations 31, weighted:
    the sum of the absolute values is d^q.
    """
    for i in range(len(qpos)):
        for c in range(3):
            out[i, c] = (qpos[i, c] - target_qpos[i, c]) / final[0]
        at = 3
        for key in _KEYS:
            for c in range(3):
                out[i, at + c] = (bodies[i, key, c] - target_bodies[i, key, c]) / final[1]
            at += 3
        for joint in range(NUM_JOINTS):
            start, weight = JOINT_QPOS[joint], _WEIGHTS[joint] / NUM_JOINTS / final[2]
            if JOINT_SIZE[joint] == 1:
                out[i, at] = weight * (qpos[i, start] - target_qpos[i, start])
                at += 1
                continue
            turn = multiply(conjugate(quaternion_at(target_qpos[i], start)), quaternion_at(qpos[i], start))
            x, y, z = logarithm(turn)
            out[i, at], out[i, at + 1], out[i, at + 2] = weight * x, weight * y, weight * z
            at += 3


if __name__ == "__main__":
    main()
