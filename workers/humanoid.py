"""The 31-DOF sword & shield figure as a MuJoCo model (sbc.md section 7).

The skeleton is `motion.skeleton`'s; shapes, masses and gains are here. `python -m workers.humanoid` prints the MJCF.
"""

from dataclasses import dataclass

import mujoco

from motion import skeleton
from workers.config import PhysicsConfig

# the warnings on which MuJoCo resets a simulation by itself
DIVERGED = [
    int(warning)
    for warning in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
]


@dataclass(frozen=True)
class Shape:
    """One collision geometry in its body's frame, and its share of the body's mass.

    kind: sphere (at a), capsule (from a to b), box (at a, half sizes b), cylinder (from a to b). Lengths in m.
    """

    body: str
    kind: str
    a: tuple
    b: tuple = ()
    radius: float = 0.0
    share: float = 1.0


def _both_sides(body, kind, a, b=(), radius=0.0, share=1.0):
    return [Shape(f"{side}_{body}", kind, a, b, radius, share) for side in ("right", "left")]


SHAPES = (
    Shape("pelvis", "sphere", (0, 0, 0.07), radius=0.09, share=0.7),
    Shape("pelvis", "sphere", (0, 0, 0.205), radius=0.07, share=0.3),
    Shape("torso", "sphere", (0, 0, 0.12), radius=0.11, share=0.8),
    Shape("torso", "capsule", (-0.006, -0.046, 0.229), (-0.017, -0.128, 0.238), 0.045, share=0.1),
    Shape("torso", "capsule", (-0.006, 0.046, 0.229), (-0.017, 0.128, 0.238), 0.045, share=0.1),
    Shape("head", "sphere", (0, 0, 0.175), radius=0.095),
    *_both_sides("upper_arm", "capsule", (0, 0, -0.05), (0, 0, -0.23), 0.045),
    *_both_sides("lower_arm", "capsule", (0, 0, -0.0525), (0, 0, -0.1875), 0.04),
    *_both_sides("hand", "sphere", (0, 0, 0), radius=0.04),
    # the sword's origin is its tip's end of the blade, 0.74 m from the hand
    Shape("sword", "capsule", (-0.70, 0, 0), (0.05, 0, 0), 0.015),
    Shape("shield", "cylinder", (0, -0.01, 0), (0, 0.01, 0), 0.25),
    *_both_sides("thigh", "capsule", (0, 0, -0.06), (0, 0, -0.36), 0.055),
    *_both_sides("shin", "capsule", (0, 0, -0.045), (0, 0, -0.355), 0.05),
    *_both_sides("foot", "box", (0.045, 0, -0.0225), (0.0885, 0.045, 0.0275)),
)

# kg, 51.7 in all
MASSES = {
    "pelvis": 6.0, "torso": 14.0, "head": 2.0, "upper_arm": 1.5, "lower_arm": 1.0, "hand": 0.5,
    "sword": 1.7, "shield": 5.0, "thigh": 4.5, "shin": 3.0, "foot": 1.0,
}  # fmt: skip

# joint: kp in N m / rad, kd in N m s / rad
GAINS = {
    "abdomen": (1000, 100), "neck": (100, 10), "shoulder": (400, 40), "elbow": (300, 30), "right_hand": (100, 10),
    "hip": (500, 50), "knee": (500, 50), "ankle": (400, 40),
}  # fmt: skip

# The actuators' force limit in units of kp: at 2 and more the simulation can explode, at the motors' own limits the
# damping would cap joint speeds far below the clips' (spec section 7)
FORCE_LIMIT = 1.5

# rad; hinges (low, high), spherical joints the largest angle from neutral. Wider than every clip of the real set.
LIMITS = {
    "abdomen": 1.8, "neck": 2.0, "right_hand": 2.7, "hip": 2.6, "ankle": 1.6,
    "elbow": (-2.8, 0.1), "knee": (-0.1, 2.8),
}  # fmt: skip

# Pairs that may overlap, besides parent and child (which MuJoCo leaves out itself), and why
EXCLUDED = (
    ("pelvis", "right_shin", "a deep crouch folds the shin against the buttock"),
    ("pelvis", "left_shin", "a deep crouch folds the shin against the buttock"),
    ("right_thigh", "left_thigh", "the capsules of the hips overlap when the feet are together"),
    ("torso", "right_lower_arm", "guards hold the forearm against the chest"),
    ("torso", "left_lower_arm", "guards hold the forearm against the chest"),
    ("head", "right_upper_arm", "a raised arm lies against the head"),
    ("head", "left_upper_arm", "a raised arm lies against the head"),
)

# Contact bits: the body meets itself and the floor, weapons only the floor (clips cut up to 11 cm into the body)
_BODY_CONTACT = 'contype="1" conaffinity="1"'
_WEAPON_CONTACT = 'contype="2" conaffinity="0"'
_FLOOR_CONTACT = 'contype="1" conaffinity="3"'


def _lookup(table, name):
    """The entry of `name`, or of its name without the side."""
    return table.get(name, table.get(name.removeprefix("right_").removeprefix("left_")))


def _numbers(values):
    return " ".join(f"{value:g}" for value in values)


def _sole(depth):
    """Contact attributes of a foot whose sole gives way over `depth` m, half of it below the box.

    MuJoCo's impedance goes from 0 to its usual largest value of 0.95 over that depth, so that the ground's force begins
    at zero; standing, the box is where it is without a sole.
    """
    return f'margin="{depth / 2:g}" solimp="0 0.95 {depth:g}" priority="1"' if depth else ""


def _geom(shape, sole):
    mass = _lookup(MASSES, shape.body) * shape.share
    contact = _WEAPON_CONTACT if shape.body in ("sword", "shield") else _BODY_CONTACT
    if shape.body in ("right_foot", "left_foot"):
        contact = f"{contact} {_sole(sole)}".rstrip()
    place = {
        "sphere": f'pos="{_numbers(shape.a)}" size="{shape.radius:g}"',
        "capsule": f'fromto="{_numbers(shape.a + shape.b)}" size="{shape.radius:g}"',
        "cylinder": f'fromto="{_numbers(shape.a + shape.b)}" size="{shape.radius:g}"',
        "box": f'pos="{_numbers(shape.a)}" size="{_numbers(shape.b)}"',
    }[shape.kind]
    return f'<geom type="{shape.kind}" {place} mass="{mass:g}" {contact}/>'


def _joint(joint):
    kind = 'type="ball"' if joint.dof == 3 else 'type="hinge" axis="0 1 0"'
    limit = _lookup(LIMITS, joint.name)
    if limit is None:
        limits = 'limited="false"'
    else:
        limits = f'range="{_numbers((0, limit) if joint.dof == 3 else limit)}"'
    _, kd = _lookup(GAINS, joint.name)
    return f'<joint name="{joint.name}" {kind} {limits} damping="{kd}"/>'


def _body(index, sole):
    body = skeleton.BODIES[index]
    lines = [f'<body name="{body.name}" pos="{_numbers(body.offset)}">']
    if index == 0:
        lines.append('<freejoint name="root"/>')
    lines += [_joint(joint) for joint in skeleton.JOINTS if joint.body == index]
    lines += [_geom(shape, sole) for shape in SHAPES if shape.body == body.name]
    lines += [_body(i, sole) for i, child in enumerate(skeleton.BODIES) if child.parent == index]
    return "\n".join(lines + ["</body>"])


def _actuators():
    """One position actuator per degree of freedom; three along x, y, z make a ball joint's exponential map."""
    lines = []
    for joint in skeleton.JOINTS:
        kp, _ = _lookup(GAINS, joint.name)
        limit = FORCE_LIMIT * kp
        for axis in range(joint.dof):
            gear = _numbers([float(axis == i) for i in range(3)]) if joint.dof == 3 else "1"
            lines.append(
                f'<position name="{joint.name}_{"xyz"[axis] if joint.dof == 3 else "y"}" joint="{joint.name}"'
                f' gear="{gear}" kp="{kp}" forcerange="{-limit:g} {limit:g}"/>'
            )
    return "\n".join(lines)


def mjcf(physics):
    """The figure on a floor as an MJCF document (str), for a `PhysicsConfig`.

    Euler's step makes the joints' damping implicit, which is all that implicitfast would do here, and the figure is one
    tree, so that islands of the solver are the whole: the same bits without either, and less time.
    """
    excludes = "\n".join(f'<exclude body1="{a}" body2="{b}"/> <!-- {why} -->' for a, b, why in EXCLUDED)
    return f"""<mujoco model="sword_and_shield">
<compiler angle="radian" autolimits="true"/>
<option timestep="{physics.timestep!r}" integrator="Euler" solver="Newton" jacobian="sparse"
  iterations="{physics.iterations}" ls_iterations="{physics.ls_iterations}" tolerance="{physics.tolerance!r}">
<flag island="disable"/>
</option>
<size memory="1M"/>
<worldbody>
<geom name="floor" type="plane" size="0 0 1" {_FLOOR_CONTACT}/>
{_body(0, physics.sole)}
</worldbody>
<contact>
{excludes}
</contact>
<actuator>
{_actuators()}
</actuator>
</mujoco>
"""


def build_model(physics):
    """The compiled `mujoco.MjModel` of the figure on a floor, for a `PhysicsConfig`."""
    return mujoco.MjModel.from_xml_string(mjcf(physics))


if __name__ == "__main__":
    print(mjcf(PhysicsConfig()))
