"""The kernel of the runtime player: rigid placement of clips on the ground, and the crossfade of two poses.

The papers' sources for the blend: Koyama and Goto 2019 leave the method free ("arbitrary motion blending methods can be
used") and name pose-space linear blending; the distance that their search minimises is that of Kovar, Gleicher and
Pighin 2002, "Motion graphs", whose blend goes with it ("Creating Transitions" there): root positions linearly,
rotations spherically, with a cubic ease-in-ease-out weight. That one is played here.

A placement is a rigid motion about the vertical, (yaw, x, y): a point p becomes R_z(yaw) p + (x, y, 0).
"""

import math

import numpy as np
from numba import njit

from motion import skeleton

# first column of every quaternion of qpos that is a joint's, and of every hinge
_BALLS = tuple(int(7 + a) for joint, a in zip(skeleton.JOINTS, skeleton.JOINT_QPOS) if joint.dof == 3)
_HINGES = tuple(int(7 + a) for joint, a in zip(skeleton.JOINTS, skeleton.JOINT_QPOS) if joint.dof == 1)

# columns of the player's integer state
LEG, LEFT, SHOWN, CLIP_A, FRAME_A, CLIP_B, FRAME_B = range(7)
STATE_SIZE = 7
FOREVER = -1  # LEFT of the last leg
NOT_BLENDING = -1  # SHOWN outside of a blend


@njit(cache=True)
def weight(shown, length):
    """Share of the second clip in frame `shown` = 0 .. length - 1 of a blend: 3 s^2 - 2 s^3, s = (shown + 1) / length.

    Kovar et al. 2002 give the share of the first clip, alpha(p) = 2 s^3 - 3 s^2 + 1, which is 1 - this. It is 0 one
    frame before the blend and 1 in its last frame, with zero slope at both ends, so that neither end shows.
    """
    s = (shown + 1) / length
    return s * s * (3 - 2 * s)


@njit(cache=True)
def compose(outer, inner, out):
    """Placement `out` (3,) = `outer` after `inner`; out may be either of them."""
    cosine, sine = math.cos(outer[0]), math.sin(outer[0])
    x, y = inner[1], inner[2]
    yaw = outer[0] + inner[0]
    out_x, out_y = cosine * x - sine * y + outer[1], sine * x + cosine * y + outer[2]
    out[0], out[1], out[2] = yaw, out_x, out_y


@njit(cache=True)
def enter(row, cycle, frame, place):
    """The frame of the clip's first cycle that shows frame `frame` >= 0 of the unwrapped clip.

    row: (start in the bank, frames, looping). cycle: placement (3,) of a looping clip's second cycle against its first.
    place (3,), a placement of the unwrapped clip, becomes that of the cycle. A clip that does not loop holds its last
    pose.
    """
    if row[2] == 0:
        return min(frame, row[1] - 1)
    period = row[1] - 1  # the last frame is the first of the next cycle
    while frame >= period:
        frame -= period
        compose(place, cycle, place)
    return frame


@njit(cache=True)
def place_pose(pose, place, out):
    """Pose `out` (47,): `pose` (47,) moved by a placement (3,); joints are left alone."""
    cosine, sine = math.cos(place[0]), math.sin(place[0])
    out[0] = cosine * pose[0] - sine * pose[1] + place[1]
    out[1] = sine * pose[0] + cosine * pose[1] + place[2]
    out[2] = pose[2]
    c, s = math.cos(0.5 * place[0]), math.sin(0.5 * place[0])
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    out[3], out[4], out[5], out[6] = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
    for i in range(7, pose.shape[0]):
        out[i] = pose[i]


@njit(cache=True)
def _slerp(a, b, at, share, out):
    """out[at : at + 4]: from quaternion a[at : at + 4] (share = 0) to b's (share = 1) by the shorter way."""
    dot = a[at] * b[at] + a[at + 1] * b[at + 1] + a[at + 2] * b[at + 2] + a[at + 3] * b[at + 3]
    sign = 1.0
    if dot < 0:
        dot, sign = -dot, -1.0
    # half the angle by its sine: acos loses half the digits near 1, where nearly all of the joints are
    chord = 0.0
    for i in range(4):
        chord += (b[at + i] * sign - a[at + i]) ** 2
    angle = 2 * math.asin(min(1.0, 0.5 * math.sqrt(chord)))
    if angle < 1e-6:  # linear to within 1e-13
        share_a, share_b = 1 - share, share * sign
    else:
        scale = 1 / math.sin(angle)
        share_a, share_b = math.sin((1 - share) * angle) * scale, math.sin(share * angle) * scale * sign
    length = 0.0
    for i in range(4):
        out[at + i] = share_a * a[at + i] + share_b * b[at + i]
        length += out[at + i] ** 2
    length = 1 / math.sqrt(length)
    for i in range(4):
        out[at + i] *= length


@njit(cache=True)
def blend_poses(a, b, share, out):
    """Pose `out` (47,) between poses a (share = 0) and b (share = 1): positions and hinges linear, rotations slerp."""
    for i in range(3):
        out[i] = a[i] + (b[i] - a[i]) * share
    _slerp(a, b, 3, share, out)
    for at in _BALLS:
        _slerp(a, b, at, share, out)
    for at in _HINGES:
        out[at] = a[at] + (b[at] - a[at]) * share


@njit(cache=True)
def begin_if_due(clips, cycles, legs, places, state, now):
    """Starts the blend into the next leg where the running leg has no frame left to be played alone."""
    if state[LEFT] == 0 and state[SHOWN] == NOT_BLENDING:
        following = state[LEG] + 1
        clip = legs[following, 0]
        state[CLIP_B] = clip
        now[1] = places[following]
        state[FRAME_B] = enter(clips[clip], cycles[clip], legs[following, 1], now[1])
        state[SHOWN] = 0


@njit(cache=True)
def show(bank, clips, now, state, lane, out):
    """Pose `out` (47,) of lane 0 (the running clip) or 1 (the one that is blended in) in the world."""
    clip, frame = (state[CLIP_A], state[FRAME_A]) if lane == 0 else (state[CLIP_B], state[FRAME_B])
    place_pose(bank[clips[clip, 0] + frame], now[lane], out)


@njit(cache=True)
def step(bank, clips, cycles, legs, places, state, now):
    """The pose (47,) to show in this frame, and the player's state one frame on.

    bank: (F, 47), the poses of all clips. clips: (n, 3), each clip's first row there, frames, looping. cycles: (n, 3),
    placement of the second cycle against the first. legs: (K, 4) the clips to play in turn: clip, unwrapped frame at
    which it is entered, frames that it is played alone (FOREVER: the last one), length of the blend that leads into it.
    places: (K, 3), the unwrapped clips' placements. state, now: what changes, integers (7,) and the placements (2, 3)
    of both lanes.
    """
    begin_if_due(clips, cycles, legs, places, state, now)
    out = np.empty(bank.shape[1])
    a = state[CLIP_A]
    if state[SHOWN] == NOT_BLENDING:
        show(bank, clips, now, state, 0, out)
        state[FRAME_A] = enter(clips[a], cycles[a], state[FRAME_A] + 1, now[0])
        if state[LEFT] > 0:
            state[LEFT] -= 1
        return out
    first, second = np.empty(bank.shape[1]), np.empty(bank.shape[1])
    show(bank, clips, now, state, 0, first)
    show(bank, clips, now, state, 1, second)
    following = state[LEG] + 1
    length = legs[following, 3]
    blend_poses(first, second, weight(state[SHOWN], length), out)
    b = state[CLIP_B]
    state[FRAME_A] = enter(clips[a], cycles[a], state[FRAME_A] + 1, now[0])
    state[FRAME_B] = enter(clips[b], cycles[b], state[FRAME_B] + 1, now[1])
    state[SHOWN] += 1
    if state[SHOWN] == length:
        state[CLIP_A], state[FRAME_A] = b, state[FRAME_B]
        now[0] = now[1]
        state[LEG], state[LEFT], state[SHOWN] = following, legs[following, 2], NOT_BLENDING
    return out
