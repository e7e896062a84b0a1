"""Rotations as torch tensors, differentiable; `motion.rotations` has those of numpy."""

import torch


def rotation(vector):
    """Rotation matrices (..., 3, 3) of exponential maps (..., 3) (Rodrigues)."""
    square = (vector * vector).sum(dim=-1)[..., None, None] + 1e-12
    angle = torch.sqrt(square)
    x, y, z = vector.unbind(dim=-1)
    o = torch.zeros_like(x)
    cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*vector.shape, 3)
    one = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return one + torch.sin(angle) / angle * cross + (1 - torch.cos(angle)) / square * (cross @ cross)


def matrices(axes):
    """Rotation matrices (..., 3, 3) of their x and z axes (..., 6)."""
    x, z = axes[..., :3], axes[..., 3:]
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def about_z(vectors, angle):
    """Vectors (B, n, 3) turned by angles (B,) about z."""
    x, y, z = vectors.unbind(dim=-1)
    c, s = torch.cos(angle)[:, None], torch.sin(angle)[:, None]
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)
