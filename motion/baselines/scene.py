"""What a task shows: the source clip going on, and the target clip where Eq. 14 puts it."""

from dataclasses import dataclass

import numpy as np

from motion import rotations
from motion.baselines.poses import blend
from motion.clip import shift_cycle
from motion.errors import InputError


@dataclass(frozen=True)
class Placement:
    """Where the target stands; the configuration's keys task.transition_time (s) and rotation.reference."""

    transition_time: float = 0.8
    reference: str = "source"


@dataclass(frozen=True, eq=False)
class Scene:
    """A task's two clips in one world. The source's root is above the origin at the moment.

    source, target: `State`s. moment: s. turn: rad, about the vertical; shift: (2,) m: a point p of the target clip
    stands at R_z(turn) p + shift. origin: (2,) m, the source's root in its clip at the moment. Times below are in
    seconds from the moment or the start point; a looping clip goes on rigidly over its seam, another holds its first
    and last pose.
    """

    source: object
    target: object
    moment: float
    turn: float
    shift: np.ndarray
    origin: np.ndarray

    def source_poses(self, times):
        """The source clip's poses (n, 47), `times` (n,) after the moment."""
        return _moved(play(self.source.clip, self.moment + np.asarray(times)), 0.0, -self.origin)

    def target_poses(self, times):
        """The target clip's poses (n, 47), `times` (n,) after its start point."""
        return _moved(play(self.target.clip, self.target.start + np.asarray(times)), self.turn, self.shift)

    @property
    def source_velocity(self):
        """qvel (37,) of the source clip at the moment."""
        return velocity_at(self.source.clip, self.moment)

    @property
    def target_velocity(self):
        """qvel (37,) of the target clip at its start point, in the world."""
        out = velocity_at(self.target.clip, self.target.start)
        out[:3] = rotations.rotate(rotations.about_z(self.turn), out[:3])
        return out


def make_scene(states, task, placement=None):
    """The `Scene` of a task; InputError, one line, if the task does not fit the states. placement: `Placement`."""
    placement = placement or Placement()
    source, moment, target, rotation = _checked(states, task)
    pose, velocity = play(source.clip, np.array([moment]))[0], velocity_at(source.clip, moment)
    start = play(target.clip, np.array([target.start]))[0]
    turn = rotation
    if placement.reference == "source":
        turn += rotations.heading(pose[3:7]) - rotations.heading(start[3:7])
    # Eq. 14: the source's velocity falls evenly to zero in transition_time
    place = 0.5 * placement.transition_time * velocity[:2]
    shift = place - rotations.rotate(rotations.about_z(turn), start[:3])[:2]
    return Scene(source, target, moment, float(turn), shift, pose[:2])


def _checked(states, task):
    """(source State, moment, target State, rotation) of a task."""
    if len(states) == 0:
        raise InputError("states: there are none; give at least one clip")
    values = np.asarray(task, dtype=np.float64)
    if values.shape != (4,) or not np.isfinite(values).all():
        raise InputError(f"task: is {task!r}; give source state, moment (s), target state, rotation (rad)")
    for name, index in (("source", values[0]), ("target", values[2])):
        if index != int(index) or not 0 <= index < len(states):
            raise InputError(f"task: {name} state {index:g} does not exist; give one of 0 .. {len(states) - 1}")
    source, target = states[int(values[0])], states[int(values[2])]
    for state in (source, target):
        if state.clip.frames < 2:
            raise InputError(f"{state.name}: has {state.clip.frames} frame(s); a transition needs at least two")
    moment, end = float(values[1]), source.clip.duration
    if not 0 <= moment <= end + 1 / source.clip.fps:
        raise InputError(f"task: moment {moment:g} s is outside {source.name}; it lasts {end:.3f} s")
    return source, min(moment, end), target, float(values[3])


def play(clip, times):
    """Poses (n, 47) of a clip at any times (n,): as `Clip.sample` within it, held or continued rigidly outside."""
    cycles = np.zeros(len(times), dtype=np.int64)
    if clip.looping:
        cycles = np.floor(times / clip.duration).astype(np.int64)
        # the clip's end is not yet the next cycle's beginning
        cycles[times == clip.duration] = 0
    at = np.clip((times - cycles * clip.duration) * clip.fps, 0, clip.frames - 1)
    low = np.minimum(at.astype(np.int64), clip.frames - 2)
    out = blend(clip.qpos[low], clip.qpos[low + 1], at - low)
    for count in np.unique(cycles[cycles != 0]):
        rows = cycles == count
        for _ in range(abs(int(count))):
            out[rows] = shift_cycle(out[rows], clip.qpos, int(np.sign(count)))
    return out


def velocity_at(clip, time):
    """qvel (37,) of a clip at `time` s, as `Clip.sample`, which takes ten times as long for poses and velocity."""
    at = min(max(time * clip.fps, 0.0), clip.frames - 1.0)
    low = min(int(at), clip.frames - 2)
    return clip.qvel[low] + (clip.qvel[low + 1] - clip.qvel[low]) * (at - low)


def _moved(qpos, turn, shift):
    """Poses (n, 47) turned about the vertical by `turn` rad and then moved by `shift` (2,) m."""
    quaternion = rotations.about_z(turn)
    qpos[:, :3] = rotations.rotate(quaternion, qpos[:, :3])
    qpos[:, :2] += shift
    qpos[:, 3:7] = rotations.multiply(quaternion, qpos[:, 3:7])
    return qpos
