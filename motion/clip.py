"""One motion clip: a sequence of poses of the 31-DOF figure at a fixed frame rate."""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from motion import rotations, skeleton
from motion.errors import InputError


@dataclass(frozen=True, eq=False)
class Clip:
    """Poses of one clip; immutable. Make one with `Clip.from_poses`, which checks its input.

    qpos: (T, 47) poses, qvel: (T, 37) velocities, both in the layout of `motion.skeleton`.
    fps: frames per second. looping: the last frame is the first one again, moved by the cycle's displacement.
    """

    name: str
    qpos: np.ndarray
    qvel: np.ndarray
    fps: float
    looping: bool = False

    @classmethod
    def from_poses(cls, name, qpos, fps, looping=False):
        """A clip of poses (T, 47), with velocities by finite differences (across the seam of a looping clip).

        Raises InputError (naming the clip) for a wrong shape, NaN, fewer than two frames, or fps that is not positive.
        """
        qpos = np.array(qpos, dtype=np.float64)
        if qpos.ndim != 2 or qpos.shape[1] != skeleton.NQ:
            raise InputError(
                f"{name}: poses have shape {qpos.shape}, not (frames, {skeleton.NQ}): is this the 31-DOF skeleton?"
            )
        if not np.isfinite(fps) or fps <= 0:
            raise InputError(f"{name}: frame rate is {fps}; give a positive number of frames per second")
        if len(qpos) < 2:
            raise InputError(f"{name}: has {len(qpos)} frame(s); velocities need at least two")
        if not np.isfinite(qpos).all():
            frame = int(np.argwhere(~np.isfinite(qpos))[0][0])
            raise InputError(f"{name}: frame {frame} holds NaN or infinity; export the clip again")
        qpos[:, 3:7] = rotations.normalize(qpos[:, 3:7])
        for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_QPOS):
            if joint.dof == 3:
                qpos[:, 7 + start : 11 + start] = rotations.normalize(qpos[:, 7 + start : 11 + start])
        if looping:
            padded = np.concatenate([shift_cycle(qpos[-2:-1], qpos, -1), qpos, shift_cycle(qpos[1:2], qpos, 1)])
            qvel = skeleton.velocities(padded, fps)[1:-1]
        else:
            qvel = skeleton.velocities(qpos, fps)
        qpos.flags.writeable = qvel.flags.writeable = False
        return cls(name, qpos, qvel, float(fps), bool(looping))

    @property
    def frames(self):
        """Number of frames T."""
        return len(self.qpos)

    @property
    def duration(self):
        """Length in seconds, (T - 1) / fps."""
        return (self.frames - 1) / self.fps

    @cached_property
    def content_hash(self):
        """Hash of poses and frame rate: two clips with the same hash give the same run."""
        digest = hashlib.sha256(np.ascontiguousarray(self.qpos).tobytes())
        digest.update(np.array([self.fps, self.looping], dtype=np.float64).tobytes())
        return digest.hexdigest()[:16]

    @property
    def joints(self):
        """Joint coordinates (T, 31): exponential maps and hinge angles."""
        return skeleton.joint_coordinates(self.qpos)

    @cached_property
    def bodies(self):
        """World positions (T, 17, 3) and quaternions (T, 17, 4) of every body."""
        return skeleton.forward_kinematics(self.qpos)

    def sample(self, time):
        """Pose (..., 47) and velocity (..., 37) at time(s) (...,) in seconds, between frames by lerp and slerp.

        Times outside [0, duration] are clamped.
        """
        at = np.clip(np.asarray(time, dtype=np.float64) * self.fps, 0, self.frames - 1)
        low = np.minimum(at.astype(np.int64), self.frames - 2)
        t = at - low
        a, b = self.qpos[low], self.qpos[low + 1]
        qpos = a + (b - a) * t[..., None]
        qpos[..., 3:7] = rotations.slerp(a[..., 3:7], b[..., 3:7], t)
        for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_QPOS):
            if joint.dof == 3:
                part = slice(7 + start, 11 + start)
                qpos[..., part] = rotations.slerp(a[..., part], b[..., part], t)
        va, vb = self.qvel[low], self.qvel[low + 1]
        return qpos, va + (vb - va) * t[..., None]

    def resample(self, fps):
        """The same motion at another frame rate; the duration is kept to within one frame of the new rate."""
        if not np.isfinite(fps) or fps <= 0:
            raise InputError(f"{self.name}: cannot resample to {fps} frames per second; give a positive number")
        # a looping clip must end on its seam, so its rate is adjusted to fit a whole number of frames
        count = max(2, int(round(self.duration * fps)) + 1) if self.looping else int(self.duration * fps + 1e-9) + 1
        rate = (count - 1) / self.duration if self.looping else fps
        qpos, _ = self.sample(np.arange(count) / rate)
        return Clip.from_poses(self.name, qpos, rate, self.looping)

    def slice(self, start, end):
        """The part from `start` to `end` seconds (to the nearest frames), as a clip that does not loop."""
        first, last = int(round(start * self.fps)), int(round(end * self.fps))
        if not 0 <= first < last <= self.frames - 1:
            raise InputError(f"{self.name}: slice {start}..{end} s lies outside the clip's 0..{self.duration:.3f} s")
        return replace(
            self,
            qpos=self.qpos[first : last + 1],
            qvel=self.qvel[first : last + 1],
            looping=False,
        )

    def contacts(self, height=0.10, speed=0.4):
        """Foot contact labels (T, 2), right then left: ankle lower than `height` m and slower than `speed` m/s."""
        position = self.bodies[0][:, skeleton.FOOT_BODIES]
        velocity = np.gradient(position, 1 / self.fps, axis=0)
        return (position[..., 2] < height) & (np.linalg.norm(velocity, axis=-1) < speed)


def shift_cycle(qpos, cycle, count):
    """Poses (..., 47) moved rigidly by `count` (+1 or -1) cycles of a looping clip's poses `cycle` (T, 47).

    One cycle turns by the change of heading from the first frame to the last and moves by the horizontal displacement.
    """
    first, last = (cycle[0], cycle[-1]) if count > 0 else (cycle[-1], cycle[0])
    turn = rotations.about_z(rotations.heading(last[3:7]) - rotations.heading(first[3:7]))
    out = np.array(qpos, dtype=np.float64)
    moved = rotations.rotate(turn, out[..., :3] - first[:3] * [1, 1, 0]) + last[:3] * [1, 1, 0]
    out[..., :3] = moved
    out[..., 3:7] = rotations.multiply(turn, out[..., 3:7])
    return out
