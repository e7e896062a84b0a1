"""Reader of poselib's SkeletonMotion: a pickled dictionary inside a `.npy` object array.

The dictionary: `rotation` {arr (T, 17, 4) local xyzw quaternions}, `root_translation` {arr (T, 3), m}, `fps`,
`is_local`, `skeleton_tree` {node_names, parent_indices {arr}, local_translation {arr}}. z is up, as here.
"""

import numpy as np

from motion import skeleton
from motion.errors import InputError
from motion.formats import pickles
from motion.formats.poses import check_numbers, make_clip

OFFSET_TOLERANCE = 1e-4  # m; the files hold float32
HINGE_TOLERANCE = 0.05  # rad of rotation about another axis than y
WELD_TOLERANCE = 0.05  # rad

_WELDED = [i for i in range(1, skeleton.NUM_BODIES) if i not in {joint.body for joint in skeleton.JOINTS}]
_EXPECTED = "the 31-DOF sword & shield figure"


def read(path, name=None, looping=None):
    """The clip in `path`. The format has no looping flag: None means False.

    Raises InputError (naming the file) for anything that is not a SkeletonMotion of this skeleton.
    """
    data = pickles.load_object_array(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds a {type(data).__name__}, not a poselib SkeletonMotion; export the clip as one")
    if data.get("is_local") is False:
        raise InputError(f"{path}: holds global rotations (is_local is False); save it with local rotations")
    tree = _get(path, data, "skeleton_tree")
    _check_skeleton(path, tree)
    rotation = _array(path, data, "rotation")
    translation = _array(path, data, "root_translation")
    frames = len(rotation) if rotation.ndim else 0
    if rotation.shape != (frames, skeleton.NUM_BODIES, 4) or translation.shape != (frames, 3):
        raise InputError(
            f"{path}: rotation {rotation.shape} and root_translation {translation.shape} are not (T, 17, 4) and (T, 3)"
        )
    # here, because the poses leave out what hinges and welds do not need
    check_numbers(path, rotation, translation)
    fps = _get(path, data, "fps")
    if not isinstance(fps, (int, float, np.number)):
        raise InputError(f"{path}: fps is {fps!r}; it must be a number")
    return make_clip(path, name, _poses(path, rotation, translation), float(fps), bool(looping))


def _poses(path, rotation, translation):
    """qpos (T, 47) of local rotations (T, 17, 4) xyzw and root positions (T, 3)."""
    rotation = rotation[..., [3, 0, 1, 2]]
    for body in _WELDED:
        angle = 2 * np.arctan2(np.linalg.norm(rotation[:, body, 1:], axis=1), np.abs(rotation[:, body, 0]))
        _refuse_above(path, angle, WELD_TOLERANCE, f"{skeleton.BODY_NAMES[body]} turns against the body it is fixed to")
    qpos = np.empty((len(rotation), skeleton.NQ))
    qpos[:, :3] = translation
    qpos[:, 3:7] = rotation[:, 0]
    for joint, start in zip(skeleton.JOINTS, skeleton.JOINT_QPOS, strict=True):
        own = rotation[:, joint.body]
        if joint.dof == 3:
            qpos[:, 7 + start : 11 + start] = own
            continue
        w, x, y, z = own.T
        _refuse_above(
            path,
            2 * np.arctan2(np.hypot(x, z), np.hypot(w, y)),
            HINGE_TOLERANCE,
            f"{joint.name} turns about another axis than y",
        )
        angle = 2 * np.arctan2(y, w)
        qpos[:, 7 + start] = np.pi - (np.pi - angle) % (2 * np.pi)  # to (-pi, pi]
    return qpos


def _refuse_above(path, angle, tolerance, what):
    if np.any(angle > tolerance):
        frame = int(np.argmax(angle > tolerance))
        amount = f"by {angle[frame]:.2f} rad in frame {frame}"
        raise InputError(f"{path}: {what} {amount}: not {_EXPECTED}; retarget the clip")


def _check_skeleton(path, tree):
    names = list(_get(path, tree, "node_names"))
    parents = _array(path, tree, "parent_indices")
    offsets = _array(path, tree, "local_translation")
    for i, own in enumerate(skeleton.BODY_NAMES):
        if i >= len(names) or names[i] != own:
            found = repr(names[i]) if i < len(names) else "missing"
            raise InputError(f"{path}: body {i} is {found}, not '{own}': not {_EXPECTED}; retarget the clip")
    if len(names) > skeleton.NUM_BODIES:
        raise InputError(f"{path}: has a body more, {names[skeleton.NUM_BODIES]!r}: not {_EXPECTED}; retarget the clip")
    if parents.shape != (skeleton.NUM_BODIES,) or offsets.shape != (skeleton.NUM_BODIES, 3):
        raise InputError(f"{path}: the skeleton's arrays do not have one row a body; export the clip again")
    for i, own in enumerate(skeleton.BODY_NAMES):
        if parents[i] != skeleton.PARENTS[i]:
            raise InputError(
                f"{path}: the parent of '{own}' is body {parents[i]:.0f}, not {skeleton.PARENTS[i]}: not {_EXPECTED};"
                " retarget the clip"
            )
        # the root's own entry is where the figure once stood
        if i > 0 and not np.all(np.abs(offsets[i] - skeleton.OFFSETS[i]) <= OFFSET_TOLERANCE):
            raise InputError(
                f"{path}: '{own}' is {np.round(offsets[i], 4).tolist()} m from its parent, not"
                f" {skeleton.OFFSETS[i].tolist()}: not {_EXPECTED}; retarget the clip"
            )


def _get(path, data, key):
    if not isinstance(data, dict) or key not in data:
        raise InputError(f"{path}: '{key}' is missing: not a poselib SkeletonMotion; export the clip as one")
    return data[key]


def _array(path, data, key):
    """The numbers of a poselib tensor {arr: array, context: ...}."""
    array = _get(path, _get(path, data, key), "arr")
    if not isinstance(array, np.ndarray):
        raise InputError(f"{path}: '{key}' is not an array; export the clip again")
    return array.astype(np.float64)
