"""What is in a state s_t (B, 282), as tensors: its two poses, and how far apart they are."""

import torch

from motion import skeleton
from workers.observation import JOINT_AXES, KEY_PLACES, POSE_SIZE


def split(observation, difference):
    """(p_t (B, 140), p_tar (B, 142)) of s_t (B, 282), p_tar as it is; difference: whether s_t has it less p_t."""
    pose, target = observation[:, :POSE_SIZE], observation[:, POSE_SIZE:]
    if difference:
        target = torch.cat([target[:, :3], target[:, 3:] + pose[:, 1:]], dim=1)
    return pose, target


def deviations(pose, target):
    """d^rp, d^kp, d^q (B, 3) (section 3, the key bodies in the frame of p_t) of p_t (B, 140) and p_tar (B, 142)."""
    keys, joints = _keys(pose, target), _joints(pose, target)
    weighted = joints.abs().sum(dim=-1) * _weights(pose)
    return torch.stack([target[:, :3].norm(dim=1), keys.norm(dim=2).sum(dim=1), weighted.mean(dim=1)], dim=1)


def residuals(pose, target, limits):
    """(B, 60): place 3, key bodies 18 and joints 39, less the target's, in thresholds (B, 3) of d^rp, d^kp and d^q.

    Their squares count alike where each deviation is spread evenly over its parts: the sum of six equal distances is
    sqrt(6) of their norm, the sum of 31 equal angles sqrt(31).
    """
    keys, joints = _keys(pose, target), _joints(pose, target) * _weights(pose)[:, None] / skeleton.NUM_JOINTS
    parts = target[:, :3], keys.flatten(1) * len(skeleton.KEY_BODIES) ** 0.5, joints.flatten(1) * skeleton.NUM_DOF**0.5
    return torch.cat([part / limits[:, k : k + 1] for k, part in enumerate(parts)], dim=1)


def _keys(pose, target):
    """(B, 6, 3): the key bodies' places less their targets'."""
    return (pose[:, KEY_PLACES] - target[:, 2:][:, KEY_PLACES]).reshape(len(pose), len(skeleton.KEY_BODIES), 3)


def _joints(pose, target):
    """(B, 13, 3): exponential maps of the joints' rotations from their targets'."""
    own, wanted = (
        _matrices(part[:, JOINT_AXES].reshape(len(pose), skeleton.NUM_JOINTS, 6)) for part in (pose, target[:, 2:])
    )  # fmt: skip
    turn = wanted.transpose(-1, -2) @ own
    axis = torch.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0], turn[..., 1, 0] - turn[..., 0, 1]], -1
    )
    sine = (axis.norm(dim=-1) / 2).clamp(min=1e-6)
    angle = torch.atan2(sine, (turn.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1) / 2)
    return axis / 2 * (angle / sine)[..., None]


def _matrices(axes):
    """Rotation matrices (..., 3, 3) of their x and z axes (..., 6)."""
    x, z = axes[..., :3], axes[..., 3:]
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def _weights(like):
    return torch.tensor(skeleton.JOINT_WEIGHTS, dtype=like.dtype, device=like.device)
