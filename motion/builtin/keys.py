"""Keyframes of the whole figure, and the clip that they make."""

from dataclasses import dataclass, replace

import numpy as np

from motion import rotations, skeleton
from motion.builtin import curves, feet, frames, limbs
from motion.clip import Clip

FPS = 30


@dataclass(frozen=True)
class Key:
    """One pose, but for the legs, which follow from the feet. Lengths in m, angles (yaw, pitch, roll) in degrees.

    pelvis: its place in the world. hips: its angles. chest: the torso's angles in the pelvis's frame. look: the head's
    yaw and pitch in the world. sword_hand, shield_hand: wrists, from the pelvis, along the world's axes. blade: where
    the sword points, in the world. sword_elbow, shield_elbow: where the elbows point, in the world.
    """

    pelvis: tuple
    hips: tuple
    chest: tuple
    look: tuple
    sword_hand: tuple
    blade: tuple
    sword_elbow: tuple
    shield_hand: tuple
    shield_elbow: tuple
    time: float = 0.0

    def at(self, time, **changes):
        """The same key at another time, with changes."""
        return replace(self, time=time, **changes)


@dataclass(frozen=True)
class Motion:
    """A clip as its author writes it: keys, keys of both feet, and what a cycle is (period s, stride m) if it loops.

    path: the pelvis's own keys, rows of time, x, y, z, where it needs more than the pose's: a flight, say.
    """

    name: str
    keys: list
    right: list
    left: list
    period: float | None = None
    stride: float = 0.0
    path: list | None = None

    @property
    def times(self):
        """Times (T,) of the clip's frames."""
        duration = self.period or self.keys[-1].time
        return np.arange(round(duration * FPS) + 1) / FPS

    def planted(self):
        """Which feet (T, 2), right then left, stand still on the whole sole."""
        tracks = [feet.track(keys, self.times, self.period, self.stride) for keys in (self.right, self.left)]
        return np.stack([planted for _, _, planted in tracks], axis=-1)

    def clip(self):
        """The `Clip`: upper body between the keys by curves of its joint rotations, legs by inverse kinematics."""
        times = self.times
        root, local = self._upper_body(times)
        for side, keys in (("right", self.right), ("left", self.left)):
            ankle, foot, _ = feet.track(keys, times, self.period, self.stride)
            hip, knee, local[f"{side}_ankle"] = limbs.leg(root[:, :3], root[:, 3:7], side, ankle, foot)
            local[f"{side}_hip"], local[f"{side}_knee"] = hip, knee[:, None]
        parts = [local[joint.name] for joint in skeleton.JOINTS]
        qpos = np.concatenate([root, *parts], axis=-1)
        return Clip.from_poses(self.name, qpos, FPS, looping=self.period is not None)

    def _upper_body(self, times):
        def field(name):
            return np.array([getattr(key, name) for key in self.keys], dtype=np.float64)

        pelvis, hips, chest = field("pelvis"), field("hips"), field("chest")
        torso, torso_rotation = self._torso(pelvis, hips, chest)
        right, right_elbow, forearm = limbs.arm(
            torso, torso_rotation, "right", pelvis + field("sword_hand"), field("sword_elbow")
        )
        left, left_elbow, _ = limbs.arm(
            torso, torso_rotation, "left", pelvis + field("shield_hand"), field("shield_elbow")
        )
        # the hand turns from the forearm by the shortest way that points the blade
        blade = rotations.rotate(rotations.conjugate(forearm), frames.unit(field("blade")))
        hand = frames.shortest(blade)

        def between(values, drift=0.0):
            return curves.curve([key.time for key in self.keys], values, times, self.period, drift)

        def turning(quaternions):
            return rotations.normalize(between(_same_side(quaternions)))

        position = between(pelvis, [self.stride, 0, 0])
        if self.path is not None:
            path = np.array(self.path)
            position = curves.curve(path[:, 0], path[:, 1:], times, self.period, [self.stride, 0, 0])
        hips, chest = between(hips), between(chest)
        rotation, chest_rotation = frames.from_angles(hips), frames.from_angles(chest)
        look = between(field("look"))
        head = frames.from_angles(np.column_stack([look, 0 * times]))
        torso_rotation = rotations.multiply(rotation, chest_rotation)
        local = {
            "abdomen": chest_rotation,
            "neck": rotations.multiply(rotations.conjugate(torso_rotation), head),
            "right_shoulder": turning(right),
            "right_elbow": between(right_elbow[:, None]),
            "right_hand": turning(hand),
            "left_shoulder": turning(left),
            "left_elbow": between(left_elbow[:, None]),
        }
        return np.concatenate([position, rotation], axis=-1), local

    @staticmethod
    def _torso(pelvis, hips, chest):
        rotation = frames.from_angles(hips)
        offset = skeleton.OFFSETS[skeleton.BODY_INDEX["torso"]]
        return pelvis + rotations.rotate(rotation, offset), rotations.multiply(rotation, frames.from_angles(chest))


def _same_side(quaternions):
    # q and -q are one rotation: keep neighbours' signs alike so that the curve takes the short way
    signs = np.ones(len(quaternions))
    for i in range(1, len(quaternions)):
        signs[i] = signs[i - 1] if quaternions[i] @ quaternions[i - 1] >= 0 else -signs[i - 1]
    return quaternions * signs[:, None]
