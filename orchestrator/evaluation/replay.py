"""One task's episode again, frame by frame: what a failure looks like, what a film shows, what a scorer measures."""

import io
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from learner.storage import replace_file
from orchestrator.evaluation.episodes import Acting, judged_config
from orchestrator.evaluation.subject import load_newest
from workers.environment import Environment
from workers.kinematics import NUM_DOF

FPS = 30.0  # policy steps per second


@dataclass(frozen=True)
class Motion:
    """An episode of T policy steps, in the world; the character's root begins above the origin.

    task: (4,), source state, moment (s), target state, rotation (rad).
    qpos: (T + 1, 47), qvel: (T + 1, 37), at 30 Hz, the first row before the first step.
    pd_target: (T, 31), joint coordinates that the PD controllers aimed at in each step (`workers.action`).
    target_qpos: (47,), target_qvel: (37,), the target in its place.
    deviations: (T + 1, 7), from the target, in the order of `workers.types.DEVIATIONS`.
    end: REACHED, FELL or TIMED_OUT of `workers.types`. fell_on: the body that touched the ground, else -1.
    """

    task: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    pd_target: np.ndarray
    target_qpos: np.ndarray
    target_qvel: np.ndarray
    deviations: np.ndarray
    end: int
    fell_on: int


def record(config, library, policy, task, limits, log_sigma, number=0):
    """The `Motion` of one task (4,), the same to the last bit as in an evaluation that gave the task this `number`.

    config: the run's `Config`; library: `MotionLibrary`; limits: `Thresholds` that end the episode; log_sigma: log of
    the actions' standard deviation in radians, -inf for none. number: the task's number in the grid, names its noise.
    """
    env = Environment(judged_config(config), library, 1)
    acting = Acting(config, policy, 1, log_sigma)
    number, row, action = np.array([number]), np.array([0]), np.zeros((1, NUM_DOF), dtype=np.float32)
    env.task[0] = task
    env.begin(row)
    frames = [_frame(env)]
    env.end[0] = 0
    while env.end[0] == 0:
        acting.act(env, number, row, action)
        env.step(action, limits)
        frames.append(_frame(env))
    qpos, qvel, deviations, pd_target = (np.array(column) for column in zip(*frames))
    return Motion(
        task=env.task[0].copy(),
        qpos=qpos,
        qvel=qvel,
        pd_target=pd_target[1:],
        target_qpos=env.target_qpos[0].copy(),
        target_qvel=env.target_qvel[0].copy(),
        deviations=deviations,
        end=int(env.end[0]),
        fell_on=int(env.fell_on[0]),
    )


def _frame(env):
    return env.qpos[0].copy(), env.qvel[0].copy(), env.deviations[0].copy(), env.pd_target[0].copy()


def load_policy(folder, config):
    """(policy, tightenings) of the newest checkpoint of a run's folder: the policy that is evaluated.

    tightenings: cuts of the thresholds that training had reached. InputError if there is none, or of other clips.
    """
    subject = load_newest(folder, config)
    return subject.policy, subject.tightenings


def save(motion, path):
    """Write a `Motion` as .npz: its fields and fps. InputError if the file cannot be written."""
    data = io.BytesIO()
    np.savez(data, fps=FPS, **{field.name: getattr(motion, field.name) for field in fields(motion)})
    replace_file(Path(path), data.getvalue())
