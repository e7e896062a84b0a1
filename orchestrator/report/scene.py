"""The figure as it is shown: the physics model's shapes with joints, a neck, a hilt, and a studio around them."""

import mujoco
import numpy as np

from orchestrator.report.phases import COLOURS
from workers.config import PhysicsConfig
from workers.humanoid import mjcf

BACKDROP = (0.235, 0.265, 0.305)
SKIN, STEEL, LEATHER = (0.93, 0.88, 0.82), (0.80, 0.83, 0.87), (0.30, 0.27, 0.26)
GHOST = 0.22  # opacity of the target that is not reached yet

# body: what is added to the physics model's shapes, as (kind, from or at, to, radius, look)
_DETAILS = {
    "pelvis": [("capsule", (0, -0.05, 0.0), (0, 0.05, 0.0), 0.075, "cloth"),
               ("capsule", (0, 0, 0.1), (0, 0, 0.26), 0.075, "cloth")],
    "torso": [("capsule", (0, 0, 0.2), (0, 0, 0.33), 0.045, "skin"),
              ("capsule", (0, -0.09, 0.16), (0, 0.09, 0.16), 0.075, "cloth")],
    "head": [("capsule", (0.05, 0, 0.17), (0.105, 0, 0.165), 0.022, "skin"),
             ("capsule", (-0.02, 0, 0.21), (0.0, 0, 0.225), 0.085, "cloth")],
    "right_hand": [("capsule", (-0.09, 0, 0), (0.06, 0, 0), 0.017, "leather"),
                   ("capsule", (0.07, -0.075, 0), (0.07, 0.075, 0), 0.013, "steel")],
    "shield": [("ellipsoid", (0, 0.012, 0), (0.09, 0.035, 0.09), 0.0, "steel"),
               ("cylinder", (0, -0.006, 0), (0, 0.006, 0), 0.262, "steel")],
    **{f"{side}_{part}": [("sphere", (0, 0, 0), (), radius, "cloth")]
       for side in ("right", "left")
       for part, radius in (("upper_arm", 0.062), ("lower_arm", 0.045), ("thigh", 0.075), ("shin", 0.056),
                            ("foot", 0.045))},
}  # fmt: skip
_LOOKS = {"sword": "steel", "head": "skin", "right_hand": "skin", "left_hand": "skin", "right_foot": "leather",
          "left_foot": "leather", "shield": "cloth"}  # fmt: skip
_KINDS = {
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE, "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER, "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
}  # fmt: skip


def build():
    """(model, looks): the `mujoco.MjModel` to draw; per geom what it is made of (cloth, skin, ...), "" the floor."""
    spec = mujoco.MjSpec.from_string(mjcf(PhysicsConfig()))
    looks = {}
    for geom in spec.geoms:
        geom.name = geom.name or f"shape{len(looks)}"
        looks[geom.name] = "" if geom.name == "floor" else _LOOKS.get(geom.parent.name, "cloth")
    for body, details in _DETAILS.items():
        for kind, a, b, radius, look in details:
            name = f"detail{len(looks)}"
            shape = {"fromto": [*a, *b], "size": [radius, 0, 0]} if kind in ("capsule", "cylinder") else {
                "pos": a, "size": b or [radius, 0, 0]}  # fmt: skip
            spec.body(body).add_geom(name=name, type=_KINDS[kind], contype=0, conaffinity=0, mass=0, **shape)
            looks[name] = look
    for look, specular, shininess in (("cloth", 0.25, 0.3), ("skin", 0.2, 0.3), ("steel", 0.9, 0.8),
                                      ("leather", 0.1, 0.1)):  # fmt: skip
        spec.add_material(name=look, specular=specular, shininess=shininess)
    for geom in spec.geoms:
        geom.material = looks[geom.name] or "floor"
    _studio(spec)
    model = spec.compile()
    return model, [looks[model.geom(i).name] for i in range(model.ngeom)]


def _studio(spec):
    """Floor, lights and backdrop."""
    line, tile = np.array(BACKDROP) * 1.6, np.array(BACKDROP) * 1.15
    spec.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT, rgb1=tile,
        mark=mujoco.mjtMark.mjMARK_EDGE, markrgb=line, width=256, height=256,
    )  # fmt: skip
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.add_material(name="floor", textures=textures, texrepeat=[1, 1], texuniform=True, specular=0.1, shininess=0.1)
    spec.geom("floor").size = [60, 60, 0.1]
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=BACKDROP, rgb2=BACKDROP, width=64, height=384,
    )  # fmt: skip
    visual = spec.visual
    visual.headlight.ambient, visual.headlight.diffuse = [0.34] * 3, [0.22] * 3
    visual.headlight.specular = [0.1] * 3
    visual.quality.shadowsize, visual.quality.offsamples = 2048, 0  # pictures are drawn larger and shrunk instead
    visual.quality.numslices, visual.quality.numstacks = 20, 12
    visual.rgba.fog = [*BACKDROP, 1]
    visual.map.shadowclip = 1
    spec.worldbody.add_light(
        name="key", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0, 0, 6], dir=[-0.35, 0.45, -1.0],
        diffuse=[0.62, 0.60, 0.57], specular=[0.3] * 3, castshadow=True,
    )  # fmt: skip
    spec.worldbody.add_light(
        name="rim", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0, 0, 6], dir=[0.8, -0.9, -0.5],
        diffuse=[0.16, 0.19, 0.24], specular=[0.15] * 3, castshadow=False,
    )  # fmt: skip


def palettes(looks):
    """Colours (phases, geoms, 4) of a figure's geoms in each phase; the floor keeps its own."""
    out = np.empty((len(COLOURS), len(looks), 4), dtype=np.float32)
    for phase, colour in enumerate(COLOURS):
        table = {"cloth": colour, "skin": SKIN, "steel": STEEL, "leather": LEATHER, "": (1, 1, 1)}
        for i, look in enumerate(looks):
            out[phase, i] = [*table[look], 1]
    return out
