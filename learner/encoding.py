"""What is in a state s_t (B, 282), as tensors: its two poses, and how far apart they are."""

import torch

from learner.rotations import matrices
from motion import skeleton
from workers.observation import JOINT_AXES, KEY_PLACES, POSE_SIZE


def split(observation, difference):
    """(p_t (B, 140), p_tar (B, 142)) of s_t (B, 282), p_tar as it is; difference: whether s_t has it less p_t."""
    pose, target = observation[:, :POSE_SIZE], observation[:, POSE_SIZE:]
    if difference:
        target = torch.cat([target[:, :3], target[:, 3:] + pose[:, 1:]], dim=1)
    return pose, target


def join(pose, target, difference):
    """The inverse of `split`."""
    if difference:
        target = torch.cat([target[:, :3], target[:, 3:] - pose[:, 1:]], dim=1)
    return torch.cat([pose, target], dim=1)


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
