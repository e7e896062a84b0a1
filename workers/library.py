"""The state machine's clips as flat arrays for the compiled planner, and poses sampled from them."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from workers.kinematics import (
    JOINT_QPOS,
    JOINT_SIZE,
    NQ,
    NUM_JOINTS,
    NV,
    conjugate,
    exponential,
    logarithm,
    multiply,
    quaternion_at,
)  # fmt: skip


@dataclass(frozen=True)
class MotionLibrary:
    """S states (clips) laid end to end, F frames in all.

    qpos (F, 47), qvel (F, 37). first, frames (S,) int64: each clip's first row and length. fps (S,).
    start (S,): start point in s. cancel (S, 2): cancel range in s. groups (G, 2) int64: allowed (source, target).
    rotation (2,): range of the target's rotation, rad.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    first: np.ndarray
    frames: np.ndarray
    fps: np.ndarray
    start: np.ndarray
    cancel: np.ndarray
    groups: np.ndarray
    rotation: np.ndarray

    def group_of(self, tasks):
        """The number (M,) int64 in `groups` of the pair of clips of each of the tasks (M, 4); -1 where it is none."""
        number = np.full((len(self.frames), len(self.frames)), -1, dtype=np.int64)
        number[self.groups[:, 0], self.groups[:, 1]] = np.arange(len(self.groups))
        return number[tasks[:, 0].astype(np.int64), tasks[:, 2].astype(np.int64)]


def build_library(state_machine):
    """The `MotionLibrary` of a `motion.state_machine.StateMachine`."""
    clips = [state.clip for state in state_machine.states]
    frames = np.array([clip.frames for clip in clips], dtype=np.int64)
    return MotionLibrary(
        qpos=np.concatenate([clip.qpos for clip in clips]),
        qvel=np.concatenate([clip.qvel for clip in clips]),
        first=np.cumsum(frames) - frames,
        frames=frames,
        fps=np.array([clip.fps for clip in clips]),
        start=np.array([state.start for state in state_machine.states], dtype=np.float64),
        cancel=np.array([state.cancel for state in state_machine.states], dtype=np.float64),
        groups=np.asarray(state_machine.groups, dtype=np.int64),
        rotation=np.array(state_machine.rotation, dtype=np.float64),
    )


@njit(cache=True)
def _slerp(a, b, t):
    x, y, z = logarithm(multiply(conjugate(a), b))
    return multiply(a, exponential(t * x, t * y, t * z))


@njit(cache=True)
def _store(out, start, q):
    # scaled to unit length: the product of many small steps would drift from it
    length = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for c in range(4):
        out[start + c] = q[c] / length


@njit(cache=True)
def sample_pose(clip_qpos, clip_qvel, first, frames, fps, time, qpos, qvel):
    """Pose into qpos (47,) and qvel (37,) of one clip at `time` s: as `motion.clip.Clip.sample`.

    clip_qpos (F, 47), clip_qvel (F, 37): the library's arrays; first, frames, fps: of the clip.
    """
    at = min(max(time * fps, 0.0), frames - 1.0)
    low = min(int(at), frames - 2)
    t = at - low
    a, b = clip_qpos[first + low], clip_qpos[first + low + 1]
    for c in range(NQ):
        qpos[c] = a[c] + (b[c] - a[c]) * t
    _store(qpos, 3, _slerp(quaternion_at(a, 3), quaternion_at(b, 3), t))
    for joint in range(NUM_JOINTS):
        if JOINT_SIZE[joint] == 3:
            start = JOINT_QPOS[joint]
            _store(qpos, start, _slerp(quaternion_at(a, start), quaternion_at(b, start), t))
    va, vb = clip_qvel[first + low], clip_qvel[first + low + 1]
    for c in range(NV):
        qvel[c] = va[c] + (vb[c] - va[c]) * t
