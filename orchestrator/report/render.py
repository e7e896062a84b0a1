"""Draw films with MuJoCo off screen. A process of its own, so that a broken OpenGL cannot take a sweep down.

usage: python -m orchestrator.report.render FOLDER

FOLDER holds `Film`s as .npz (`save`); beside each NAME.npz comes NAME.webp, written at once when it is done. The
environment variable MUJOCO_GL chooses the backend: egl, osmesa, ... (see docs/report.md). Poses in, pictures out:
nothing here knows of policies.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orchestrator.report.phases import TARGET

SLOW = 2  # times slower than life: transitions take a quarter of a second
FPS = 30
STRIP, VIDEO = "strip", "video"
CELL = (120, 288)  # pixels of one figure of a strip: as wide as it is apart from the next, and high
SPACING = 1.05  # m in the picture between two figures of a strip
PANE = (340, 320)  # pixels of one figure's part of a video
SMOOTH = 9  # frames over which the camera's path is averaged
HOLD = 700  # ms that the last picture of a video stays
AZIMUTH, ELEVATION = 122.0, -11.0  # degrees; the camera looks at the sword's side, from ahead
FOV = 18.0  # degrees; small, so that figures at a strip's ends are seen as those in its middle
SHADE = 7.0  # m around what is looked at in which shadows fall; finer ones speckle the floor
MOST_GEOMS = 4000  # in one picture; a figure has about 55
HEIGHT = 1.1  # m above the floor, of the picture's middle
FINER = {STRIP: 2.0, VIDEO: 1.5}  # drawn so many times larger and shrunk: cheaper than multisampling without a GPU


@dataclass(frozen=True)
class Film:
    """Takes to draw. kind: STRIP, one row of figures of one take, at the rows `chosen` of its poses; VIDEO, takes
    side by side. qpos: list of (T, 47). phase: list of (T,). ghost: list of (47,), the targets."""

    kind: str
    qpos: list
    phase: list
    ghost: list
    chosen: np.ndarray | None = None


def save(film, path):
    """Write a `Film` for this module's process."""
    arrays = {"kind": film.kind, "count": len(film.qpos)}
    if film.chosen is not None:
        arrays["chosen"] = film.chosen
    for i, (qpos, phase, ghost) in enumerate(zip(film.qpos, film.phase, film.ghost, strict=True)):
        arrays |= {f"qpos{i}": qpos, f"phase{i}": phase, f"ghost{i}": ghost}
    np.savez(path, **arrays)


def load(path):
    """The `Film` that `save` wrote."""
    with np.load(path) as data:
        lists = [[data[f"{name}{i}"] for i in range(int(data["count"]))] for name in ("qpos", "phase", "ghost")]
        return Film(str(data["kind"]), *lists, data["chosen"] if "chosen" in data else None)


class Studio:
    """One scene and one OpenGL context."""

    def __init__(self):
        import mujoco

        from orchestrator.report import scene

        self._mujoco, self._background = mujoco, scene.BACKDROP
        self._model, looks = scene.build()
        self._data = mujoco.MjData(self._model)
        self._palettes = scene.palettes(looks)
        self._ghost_colours = self._palettes[TARGET].copy()
        self._ghost_colours[[bool(look) for look in looks], 3] = scene.GHOST
        self._model.vis.global_.fovy = FOV
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._renderer = self._made_for = None

    def picture(self, figures, size, look_at, high, light):
        """An RGB picture (height, width, 3) of figures [(qpos (47,), colours (geoms, 4))]: the first one is solid.

        size: (width, height), pixels. look_at: (3,) m. high: m that the picture's height shows. light: m around
        look_at in which shadows fall.
        """
        mujoco, model, data = self._mujoco, self._model, self._data
        width, height = size
        camera = mujoco.MjvCamera()
        camera.azimuth, camera.elevation, camera.lookat[:] = AZIMUTH, ELEVATION, look_at
        camera.distance = 0.5 * high / np.tan(np.radians(FOV) / 2)
        if self._made_for != (width, height, high, light):  # a context keeps sizes, fog and the shadows' reach
            self.close()
            self._made_for = width, height, high, light
            visual, model.stat.extent = model.vis, light
            visual.map.fogstart, visual.map.fogend = (camera.distance + np.array([2, 14])) / light
            visual.map.zfar = 80 / light
            visual.global_.offwidth, visual.global_.offheight = width, height
            self._renderer = mujoco.Renderer(model, height, width, max_geom=MOST_GEOMS)
        renderer = self._renderer
        for number, (qpos, colours) in enumerate(figures):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            model.geom_rgba[:] = colours
            if number == 0:
                mujoco.mj_camlight(model, data)
                data.light_xpos[:] = look_at - 8 * data.light_xdir  # so that shadows fall around what is looked at
                renderer.update_scene(data, camera)
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = 1
            else:
                kinds = mujoco.mjtCatBit.mjCAT_DYNAMIC
                mujoco.mjv_addGeoms(model, data, self._option, self._perturb, kinds, renderer.scene)
        return renderer.render()

    def close(self):
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = self._made_for = None

    def strip(self, film):
        """The one picture of a STRIP: its figures side by side, the camera going with each."""
        count = len(film.chosen)
        poses = film.qpos[0][film.chosen].copy()
        azimuth = np.radians(AZIMUTH)
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0])
        shifts = (np.arange(count) - (count - 1) / 2)[:, None] * SPACING * right
        poses[:, :2] = shifts[:, :2]
        figures = [(q, self._palettes[p]) for q, p in zip(poses, film.phase[0][film.chosen])]
        size, high = finer(STRIP, count * CELL[0], CELL[1]), SPACING * CELL[1] / CELL[0]
        return self.picture(figures, size, (0, 0, HEIGHT), high, max(SHADE, 0.5 * count * SPACING + 1))

    def video(self, film):
        """The pictures of a VIDEO, one by one."""
        for k in range(max(map(len, film.qpos))):
            yield np.concatenate([self._pane(film, i, min(k, len(film.qpos[i]) - 1)) for i in range(len(film.qpos))], 1)

    def _pane(self, film, i, k):
        qpos, phase = film.qpos[i], film.phase[i]
        figures = [(qpos[k], self._palettes[phase[k]])]
        if phase[k] != TARGET:
            figures.append((film.ghost[i], self._ghost_colours))
        around = np.clip(np.arange(k - SMOOTH, k + SMOOTH + 1), 0, len(qpos) - 1)
        middle = 0.75 * qpos[around, :2].mean(axis=0) + 0.25 * film.ghost[i][:2]
        return self.picture(figures, finer(VIDEO, *PANE), (*middle, 0.95), 2.4, SHADE)


def finer(kind, width, height):
    """(width, height) in which a picture is drawn, pixels."""
    return round(FINER[kind] * width), round(FINER[kind] * height)


def shrunk(picture, kind):
    """A drawn picture (h, w, 3) at its size, as a Pillow image."""
    from PIL import Image

    image = Image.fromarray(picture)
    size = round(image.width / FINER[kind]), round(image.height / FINER[kind])
    return image.resize(size, Image.Resampling.LANCZOS)


def write(studio, film, path):
    """Draw a film and write it as WebP, animated if it is a VIDEO."""
    part = path.with_suffix(".part")
    if film.kind == STRIP:
        shrunk(studio.strip(film), STRIP).save(part, format="WEBP", quality=82, method=4)
    else:
        first, *rest = [shrunk(picture, VIDEO) for picture in studio.video(film)]
        times = [SLOW * 1000 // FPS] * len(rest) + [HOLD]
        first.save(
            part, format="WEBP", save_all=True, append_images=rest, duration=times, loop=0, quality=75, method=2
        )
    part.replace(path)


def main(arguments):
    """Draw all films in a folder, in the order of their names."""
    studio = Studio()
    for path in sorted(Path(arguments[0]).glob("*.npz")):
        write(studio, load(path), path.with_suffix(".webp"))
    studio.close()


if __name__ == "__main__":
    main(sys.argv[1:])
