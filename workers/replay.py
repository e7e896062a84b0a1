"""Replay a simulation that exploded, from the file that the run left in its folder.

usage: python -m workers.replay FILE

  python -m workers.replay runs/ablation/ours-seed0/faults/unstable-00000012-00000003.npz

Prints each step's largest speed, and of the last step each physics step's.
"""

import sys

import mujoco
import numpy as np

from motion.errors import InputError
from workers.dump import read
from workers.environment import Environment
from workers.types import FELL


def replay(dump):
    """Step a `Dump` again: (speeds, whether it went the same way to the last bit).

    speeds: largest of |qvel| (m/s, rad/s) after each of its K - 1 first steps, then after each physics step of the
    last, which exploded.
    """
    env = Environment(dump.config, None, 1)
    env.load(dump.state)
    speeds, same = [], True
    for action, pose in zip(dump.action, dump.pose):
        same &= np.array_equal(np.concatenate([env.qpos[0], env.qvel[0]]).astype(np.float32), pose)
        data = env._batch.get_data(0)
        env.step(action[None], dump.thresholds)
        speeds.append(np.abs(env.qvel).max())
    same &= bool(env.end[0] == FELL and env.fell_on[0] == -1)
    data.ctrl[:] = env._ctrl[0]
    del speeds[-1]
    env._batch.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # show the numbers that MuJoCo gave up
    for _ in range(dump.config.physics.substeps):
        mujoco.mj_step(env._batch.model, data)
        speeds.append(np.abs(data.qvel).max())
    return np.array(speeds), same


def main(arguments):
    """Command line; returns the exit status, 0 only if the replay went as recorded."""
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print(__doc__)
        return 2
    try:
        dump = read(arguments[0])
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    state, steps = dump.state, len(dump.action)
    source, moment, target, rotation = state.task[0]
    print(f"environment {state.environment[0]}, iteration {dump.iteration}, seed {dump.seed}, clock {state.clock}")
    print(f"task: state {source:.0f} at {moment:.3f} s to state {target:.0f}, turned by {rotation:.3f} rad")
    print(f"recorded: {steps} steps of the episode, which began {state.steps[0]} steps before")
    speeds, same = replay(dump)
    for step, speed in enumerate(speeds[: steps - 1]):
        print(f"step {step + 1}: largest speed {speed:.1f}")
    for substep, speed in enumerate(speeds[steps - 1 :]):
        print(f"step {steps}, physics step {substep + 1}: largest speed {speed:.4g}")
    print("exploded as recorded" if same else "went another way than recorded (another machine or MuJoCo?)")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
