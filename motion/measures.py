"""What is judged by eye, measured from poses alone: foot skate, ground penetration, jumps of velocity, jerk.

No label of a clip and no physics is read, so a simulated, a blended and a captured motion are judged alike. Velocities
are those from one frame to the next, as a viewer sees them. qpos is (T, 47) at `fps` frames per second throughout.
"""

import numpy as np

from motion import rotations, skeleton

# corners of the sole in the foot's frame, m: the lower side of workers.humanoid's box
SOLE = np.array([(x, y, -0.05) for x in (-0.0435, 0.1335) for y in (-0.045, 0.045)])
GROUND = 0.02  # m; a corner of the sole below this is on the ground
SKATE = 0.05  # m/s; a planted foot that is faster slides visibly


def horizontal_speed(points, fps):
    """(T - 1, ...) m/s, speed over the ground of points (T, ..., 3) from each frame to the next."""
    return np.linalg.norm(np.diff(points[..., :2], axis=0), axis=-1) * fps


def velocity_change(points, fps, apart=1):
    """(T - 1 - apart, ...) m/s, how much the velocity of points (T, ..., 3) changes within `apart` frames."""
    velocity = np.diff(points, axis=0) * fps
    return np.linalg.norm(velocity[apart:] - velocity[:-apart], axis=-1)


def soles(qpos):
    """(T, 2, 4, 3) m, the corners of the soles in the world, right foot first."""
    position, rotation = skeleton.forward_kinematics(qpos)
    feet = skeleton.FOOT_BODIES
    return position[:, feet, None] + rotations.rotate(rotation[:, feet, None], SOLE)


def foot_speed(qpos, fps):
    """(T - 1, 2) m/s, horizontal speed of both feet from each frame to the next; NaN where one is not planted.

    A foot is planted while at least one corner of its sole is on the ground (lower than GROUND) at both frames; its
    speed is the mean over these corners, so that a heel may rise while the toes stay.
    """
    corners = soles(qpos)
    low = corners[..., 2] < GROUND
    down = low[1:] & low[:-1]
    count = down.sum(axis=-1)
    total = np.where(down, horizontal_speed(corners, fps), 0.0).sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def foot_skate(qpos, fps):
    """(mean horizontal speed of planted feet in m/s, share of their frames above SKATE); NaN if none is planted."""
    speed = foot_speed(qpos, fps)
    speed = speed[np.isfinite(speed)]
    return (float(speed.mean()), float((speed > SKATE).mean())) if len(speed) else (np.nan, np.nan)


def penetration(qpos):
    """(T,) m, how deep the lowest corner of a sole is below the floor; 0 where none is."""
    return np.maximum(0.0, -soles(qpos)[..., 2].min(axis=(1, 2)))


def root_velocity_jump(qpos, fps):
    """(T - 2,) m/s, change of the root's velocity at each frame but the first and last."""
    return velocity_change(qpos[:, :3], fps)


def joint_velocity_jump(qpos, fps):
    """(T - 2,) rad/s, change of joint velocity at each frame but the first and last, of the joint that changes most."""
    turns = skeleton.joint_quaternions(qpos)
    rate = rotations.to_exponential_map(rotations.multiply(rotations.conjugate(turns[:-1]), turns[1:])) * fps
    return np.linalg.norm(np.diff(rate, axis=0), axis=-1).max(axis=1)


def jerk(qpos, fps):
    """(T - 3,) m/s^3, size of the third difference of position, mean over the 17 bodies."""
    position, _ = skeleton.forward_kinematics(qpos)
    return np.linalg.norm(np.diff(position, 3, axis=0), axis=-1).mean(axis=-1) * fps**3
