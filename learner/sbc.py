"""Self-Behavior Cloning (Algorithm 1, Eq. 17): the poses that a trajectory went through become its targets."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from workers.action import ABSOLUTE, MODES, TARGET, encode
from workers.kinematics import NQ, NUM_BODIES, NUM_DOF, forward_kinematics
from workers.observation import OBSERVATION_SIZE, observe


@dataclass(frozen=True)
class Pairs:
    """M pairs (t, k) of one chunk: step[m] = t, target[m] = k - 1 (p_k is next_pose[k - 1]), column[m] = environment.

    int32 arrays (M,). The gap is k - t = target - step + 1.
    """

    step: np.ndarray
    target: np.ndarray
    column: np.ndarray

    def __len__(self):
        return len(self.step)

    def gap(self):
        """k - t, (M,)."""
        return self.target - self.step + 1


def valid_pairs(pose, next_pose, end):
    """All valid pairs of a chunk: Algorithm 1's store as indices, whose states are made when they are drawn.

    pose, next_pose: (T, N, >= 3), root position first, before and after every step. end: (T, N), nonzero where an
    episode ended. A pair lies in one uninterrupted trajectory; it is valid if the demonstrated step brings the root
    nearer to p_k: |R_t - R_k| - |R_{t+1} - R_k| > 0. The pose before a reset is a target too.
    """
    horizon, n = end.shape
    over = end != 0
    # episodes completed before step t: steps t and j are of one trajectory if it is the same number
    segment = np.cumsum(over, axis=0) - over
    before, after = pose[..., :3], next_pose[..., :3]
    found = []
    for gap in range(1, horizon + 1):
        steps = horizon - gap + 1
        goal = after[gap - 1 :]
        nearer = np.linalg.norm(before[:steps] - goal, axis=-1) - np.linalg.norm(after[:steps] - goal, axis=-1) > 0
        step, column = np.nonzero(nearer & (segment[:steps] == segment[gap - 1 :]))
        found.append((step, step + gap - 1, column))
    return Pairs(*(np.concatenate(arrays).astype(np.int32) for arrays in zip(*found)))


def gap_weights(gap, poses, weighting):
    """g of Eq. 17 for gaps k - t (M,) in trajectories of T = `poses` poses, float32.

    `balanced` (T-1)/(T-gap) makes up for there being only T - gap pairs of each gap.
    """
    if weighting == "balanced":
        weight = (poses - 1) / (poses - gap)
    elif weighting == "inverse":
        weight = (poses - 1) / gap
    else:
        weight = np.ones(len(gap))
    return weight.astype(np.float32)


@njit(cache=True)
def _demonstrate(poses, targets, pd_target, mode, scale, difference, observation, action):
    bodies, rotations = np.empty((NUM_BODIES, 3)), np.empty((NUM_BODIES, 4))
    target_bodies = np.empty((NUM_BODIES, 3))
    for m in range(len(poses)):
        qpos, target = poses[m, :NQ], targets[m, :NQ]
        forward_kinematics(qpos, bodies, rotations)
        forward_kinematics(target, target_bodies, rotations)
        observe(qpos, poses[m, NQ:], bodies, target, targets[m, NQ:], target_bodies, difference, observation[m])
        encode(pd_target[m], target if mode == TARGET else qpos, scale, mode == ABSOLUTE, action[m])


def demonstrations(chunk, pairs, chosen, env):
    """(observation (K, 282), action (K, 31)), float32, of the pairs numbered `chosen` (K,); env: `EnvConfig`.

    p_k is localized to p_t, and the action expressed around the retargeted pose where `action.mode` is an offset.
    """
    step, target, column = pairs.step[chosen], pairs.target[chosen], pairs.column[chosen]
    observation = np.empty((len(chosen), OBSERVATION_SIZE), dtype=np.float32)
    action = np.empty((len(chosen), NUM_DOF), dtype=np.float32)
    _demonstrate(
        chunk.pose[step, column].astype(np.float64),
        chunk.next_pose[target, column].astype(np.float64),
        chunk.pd_target[step, column].astype(np.float64),
        MODES[env.action.mode],
        env.action.scale,
        env.observation.target == "difference",
        observation,
        action,
    )
    return observation, action


def sbc_loss(mean, action, weight, config):
    """Eq. 17: w_sbc * sum_i g_i |a_i - mean_i|^2 of tensors (K, 31), (K, 31), (K,); its mean if so configured."""
    per_demonstration = weight * ((action - mean) ** 2).sum(dim=-1)
    total = per_demonstration.sum() if config.reduction == "sum" else per_demonstration.mean()
    return config.weight * total
