"""Descent of what is left to the target at arrival, through the learned physics of the last steps (not in the paper).

PPO learns from one number per episode; the pose that it came to says in all its numbers how to correct. Of every
episode of a chunk that came near its target, the last K steps before it was nearest are followed again: the policy of
now, at the states and with the noise of then, and what a `learner.dynamics.Dynamics` says that its changes would have
changed. Values are those that were observed, derivatives the network's: a stochastic value gradient (Heess et al.,
"Learning continuous control policies by stochastic value gradients", 2015) of the largest of the three deviations, by
what an action does and by what later actions make of it. It is far steadier than PPO's gradient: a twentieth of its
length is enough, a third is too much (lab book, section 14).
"""

import numpy as np
import torch

from learner.dynamics import moved
from learner.rotations import matrices
from learner.state import ARRIVALS, PHYSICS
from motion import skeleton
from workers.observation import JOINT_AXES, KEY_PLACES
from workers.types import judging

NEAR = 4.0  # thresholds; who came no nearer is left to PPO
_POWER = 4  # of the norm that stands for the largest of the three deviations


class Arrival:
    """Of one update: lets the dynamics learn from the chunk, then gives gradients; nothing if `arrival.weight` is 0."""

    def __init__(self, state, chunk):
        self._state, self._windows, self._metrics = state, (), {}
        if not state.config.arrival.weight:
            return
        self._random = state.random(ARRIVALS)
        horizon, n = chunk.end.shape
        following = np.concatenate([chunk.observation[1:], chunk.last_observation[None]])
        following[np.nonzero(chunk.end)] = chunk.final_observation  # in the order of nonzero
        self._observation, self._following, self._action, self._mean = (
            torch.as_tensor(np.ascontiguousarray(array).reshape(horizon * n, -1), device=state.device)
            for array in (chunk.observation, following, chunk.action, chunk.mean)
        )
        self._metrics = {"loss/arrival": 0.0, "gradient/arrival": 0.0, "loss/dynamics": self._learn(chunk)}
        self._near(chunk)

    def _learn(self, chunk):
        state, samples = self._state, chunk.end.size
        move = moved(chunk.pose, chunk.next_pose).reshape(samples, -1).astype(np.float32)
        move = torch.as_tensor(move, device=state.device)
        order = state.random(PHYSICS).permutation(samples)
        batches = np.array_split(order, -(-samples // state.config.ppo.minibatch_size))
        return state.dynamics.learn(self._observation, self._action, self._following, move, batches)

    def _near(self, chunk):
        """Find the windows: rows (M,) of their first steps, and the thresholds (M, 3) of their episodes' ends."""
        state, steps = self._state, self._state.config.arrival.steps
        horizon, n = chunk.end.shape
        with torch.no_grad():
            left = deviations(*state.dynamics.split(self._following)).cpu().numpy().reshape(horizon, n, 3)
        explores = ~judging(chunk.environment, state.config.policy.judges)
        rows, limits = [], []
        begin = np.zeros(n, dtype=np.int64)
        for (t, i), limit in zip(np.argwhere(chunk.end), chunk.final_thresholds):
            ratio = (left[begin[i] : t + 1, i] / limit).max(axis=1)
            first = begin[i] + int(ratio.argmin()) - steps + 1
            if explores[i] and ratio.min() < NEAR and first >= begin[i]:
                rows.append(first * n + i)
                limits.append(limit)
            begin[i] = t + 1
        if not rows:
            return
        self._windows, self._n = np.array(rows, dtype=np.int64), n
        self._limits = torch.as_tensor(np.array(limits), dtype=torch.float32, device=state.device)
        # what the network misses of the steps that were observed: with it, values are theirs
        every = [self._windows + k * n for k in range(steps)]
        with torch.no_grad():
            self._missing = [
                self._following[at] - state.dynamics.step(self._observation[at], self._action[at]) for at in every
            ]

    def gradient(self):
        """(what to add to the policy's gradients, in its parameters' order, or None; metrics) of a few windows."""
        if not len(self._windows):
            return None, self._metrics
        state, config = self._state, self._state.config.arrival
        chosen = self._random.integers(len(self._windows), size=config.batch_size)
        loss = self._loss(chosen)
        parameters = list(state.policy.parameters())
        found = torch.autograd.grad(loss, parameters)
        norm = torch.sqrt(sum((gradient**2).sum() for gradient in found))
        factor = config.weight * (state.config.ppo.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
        metrics = {**self._metrics, "loss/arrival": loss.detach(), "gradient/arrival": norm}
        return [factor * gradient for gradient in found], metrics

    def _loss(self, chosen):
        """Mean over the windows chosen (B,) of the largest deviation at arrival, in thresholds, cut off at NEAR."""
        state, rows = self._state, self._windows[chosen]
        observation = self._observation[rows]
        for k, missing in enumerate(self._missing):
            noise = self._action[rows + k * self._n] - self._mean[rows + k * self._n]
            action = state.policy(state.observations(observation)) + noise
            observation = state.dynamics.step(observation, action) + missing[chosen]
        ratio = deviations(*state.dynamics.split(observation)) / self._limits[chosen]
        return ((ratio**_POWER).sum(dim=1) + 1e-6).pow(1 / _POWER).clamp(max=NEAR).mean()


def deviations(pose, target):
    """d^rp, d^kp, d^q (B, 3) (section 3, the key bodies in the frame of p_t) of p_t (B, 140) and p_tar (B, 142)."""
    alike = target[:, 2:]
    keys = (alike[:, KEY_PLACES] - pose[:, KEY_PLACES]).reshape(len(pose), -1, 3).norm(dim=2).sum(dim=1)
    own, wanted = (
        matrices(part[:, JOINT_AXES].reshape(len(pose), skeleton.NUM_JOINTS, 6)) for part in (pose, alike)
    )  # fmt: skip
    turn = wanted.transpose(-1, -2) @ own
    axis = torch.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0], turn[..., 1, 0] - turn[..., 0, 1]], -1
    )
    sine = (axis.norm(dim=-1) / 2).clamp(min=1e-6)
    angle = torch.atan2(sine, (turn.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1) / 2)
    logarithm = axis / 2 * (angle / sine)[..., None]
    weights = torch.tensor(skeleton.JOINT_WEIGHTS, dtype=pose.dtype, device=pose.device)
    joints = (logarithm.abs().sum(dim=-1) * weights).mean(dim=1)
    return torch.stack([target[:, :3].norm(dim=1), keys, joints], dim=1)
