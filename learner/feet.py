"""The corners of the soles as functions of p_t: the contact that they make decides what a step does to the figure."""

import torch

from learner.rotations import matrices
from motion import skeleton
from workers.humanoid import SHAPES
from workers.observation import JOINT_AXES, JOINT_RATES, ROOT_AXES, ROOT_SPIN, ROOT_VELOCITY

SIZE = 64
_SIDES = ("right", "left")
_LEGS = [[skeleton.JOINT_INDEX[f"{side}_{name}"] for side in _SIDES] for name in ("hip", "knee", "ankle")]
_OFFSETS = [
    [skeleton.BODIES[skeleton.BODY_INDEX[f"{side}_{name}"]].offset for side in _SIDES]
    for name in ("thigh", "shin", "foot")
]
_BOX = next(shape for shape in SHAPES if shape.body == "right_foot")  # the left one is the same
_CORNERS = [
    [_BOX.a[0] + x * _BOX.b[0], _BOX.a[1] + y * _BOX.b[1], _BOX.a[2] - _BOX.b[2]] for x in (-1, 1) for y in (-1, 1)
]
_HIGH = 0.3  # m, above which the height of a corner says nothing
_SOFT = 0.01  # m, over which a corner counts as touching little by little, about a sole's depth


def contact(pose):
    """(B, 64) of p_t (B, 140): per corner its height (m), 0 to 1 how much it touches, its velocity (m/s) in the heading
    frame, and that velocity times how much it touches."""
    height, velocity = corners(pose)
    touch = torch.sigmoid(-height / _SOFT)
    parts = [height.clamp(max=_HIGH), touch, velocity.flatten(1), (velocity * touch[..., None]).flatten(1)]
    return torch.cat(parts, dim=1)


def corners(pose):
    """Heights (B, 8) and velocities (B, 8, 3), in the heading frame, of the corners of the right and the left sole."""
    count = len(pose)
    # both legs at once: (B, 2, ...)
    rotation = matrices(pose[:, ROOT_AXES])[:, None].expand(-1, 2, -1, -1)
    spin, velocity = (pose[:, part][:, None].expand(-1, 2, -1) for part in (ROOT_SPIN, ROOT_VELOCITY))
    axes = pose[:, JOINT_AXES].reshape(count, -1, 6)
    place = torch.zeros_like(velocity)
    for joints, offsets in zip(_LEGS, _OFFSETS):
        arm = _turn(rotation, pose.new_tensor(offsets).expand(count, -1, -1))
        place, velocity = place + arm, velocity + torch.linalg.cross(spin, arm)
        rotation = rotation @ matrices(axes[:, joints])
        rate = torch.stack([_rate(pose, joint) for joint in joints], dim=1)
        spin = spin + _turn(rotation, rate)  # rates are those of the child's frame
    arm = torch.einsum("bsij,kj->bski", rotation, pose.new_tensor(_CORNERS))
    height = pose[:, :1] + (place[:, :, None, 2] + arm[..., 2]).flatten(1)
    velocity = velocity[:, :, None] + torch.linalg.cross(spin[:, :, None].expand_as(arm), arm)
    return height, velocity.flatten(1, 2)


def _turn(rotation, vector):
    return (rotation @ vector[..., None])[..., 0]


def _rate(pose, joint):
    """Angular velocity (B, 3) of a joint; a hinge turns about y."""
    start = JOINT_RATES.start + int(skeleton.JOINT_DOF[joint])
    if skeleton.JOINTS[joint].dof == 3:
        return pose[:, start : start + 3]
    return torch.nn.functional.pad(pose[:, start : start + 1], (1, 1))
