"""One transition as it is shown, between its two clips, and its numbers: the same code for every method."""

from dataclasses import dataclass

import numpy as np

from motion import measures, skeleton

CONTEXT = 3  # frames of the clips on either side: what a third difference at the seam needs

METRICS = {  # name: (unit, one line)
    "foot_skate_speed": ("m/s", "mean horizontal speed of the feet while they are on the ground"),
    "foot_skate_share": ("", f"share of planted-foot frames above {measures.SKATE:g} m/s"),
    "penetration": ("m", "mean depth of the lowest point of the soles below the floor"),
    "root_velocity_jump": ("m/s", "largest change of the root's velocity from frame to frame, both seams included"),
    "joint_velocity_jump": ("rad/s", "largest change of a joint's velocity from frame to frame, both seams included"),
    "root_velocity_jump_inside": ("m/s", "the same without the last frame, where the target clip takes over"),
    "joint_velocity_jump_inside": ("rad/s", "the same without the last frame, where the target clip takes over"),
    "handover": ("m", "mean distance of the bodies in the last frame from where the target clip goes on"),
    "jerk": ("m/s^3", "mean jerk of the bodies, both seams included"),
    "residual_force": ("body weight", "mean force that no contact explains, at the root, by inverse dynamics"),
    "residual_moment": ("body weight x height", "mean moment that no contact explains, at the root"),
    "torque_excess_share": ("", "share of frames in which a joint torque is above its actuator's limit"),
}


@dataclass(frozen=True, eq=False)
class Shown:
    """A transition between its clips. qpos: (T, 47), what the method made, at `fps`. before, after: (up to CONTEXT, 47)
    poses of the clips on either side; none after a transition that does not reach its target. landing: (47,) where the
    target clip has the last pose, or None."""

    qpos: np.ndarray
    before: np.ndarray
    after: np.ndarray
    landing: np.ndarray | None
    fps: float

    @property
    def duration(self):
        """s."""
        return (len(self.qpos) - 1) / self.fps


def shown(scene, qpos, fps, elapsed=None):
    """`Shown` of what a method made of a `Scene`. elapsed: s after its start point at which the target clip stands in
    the last frame; None: the target was not reached."""
    ahead = np.arange(-CONTEXT, 0) / fps
    if not scene.source.clip.looping:
        ahead = ahead[scene.moment + ahead >= 0]
    before = scene.source_poses(ahead)
    if elapsed is None:
        return Shown(qpos, before, qpos[:0], None, fps)
    rest = scene.target_poses(elapsed + np.arange(CONTEXT + 1) / fps)
    return Shown(qpos, before, rest[1:], rest[0], fps)


def score(item, judge):
    """{name of METRICS: float} of a `Shown`; NaN where a transition is too short or no foot is planted.

    judge: `workers.plausibility.Judge`.
    """
    qpos, fps = item.qpos, item.fps
    whole = np.concatenate([item.before, qpos, item.after])
    speed, share = measures.foot_skate(qpos, fps)
    verdict = judge.judge(qpos, fps)
    inside = slice(None, len(item.before) + len(qpos))
    return {
        "foot_skate_speed": speed,
        "foot_skate_share": share,
        "penetration": float(measures.penetration(qpos).mean()),
        "root_velocity_jump": _largest(measures.root_velocity_jump, whole, item),
        "joint_velocity_jump": _largest(measures.joint_velocity_jump, whole, item),
        "root_velocity_jump_inside": _largest(measures.root_velocity_jump, whole[inside], item),
        "joint_velocity_jump_inside": _largest(measures.joint_velocity_jump, whole[inside], item),
        "handover": np.nan if item.landing is None else _distance(qpos[-1], item.landing),
        "jerk": _mean(measures.jerk(whole, fps)) if len(whole) > 3 else np.nan,
        "residual_force": _mean(verdict.relative_force),
        "residual_moment": _mean(verdict.relative_moment),
        "torque_excess_share": _mean(verdict.torque_excess),
    }


def _largest(measure, whole, item):
    """Largest value at a frame of the transition; measure(qpos, fps)[k] is that of frame k + 1."""
    first = max(0, len(item.before) - 1)
    values = measure(whole, item.fps)[first : len(item.before) + len(item.qpos) - 1] if len(whole) > 2 else ()
    return float(np.max(values)) if len(values) else np.nan


def _mean(values):
    return float(np.mean(values)) if len(values) else np.nan


def _distance(a, b):
    """Mean distance (m) of the bodies of two poses."""
    a, b = (skeleton.forward_kinematics(pose)[0] for pose in (a, b))
    return float(np.linalg.norm(a - b, axis=-1).mean())
