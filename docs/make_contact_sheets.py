"""Draws the built-in clips as stick figures: `python docs/make_contact_sheets.py [--clips NAME ...] [--out PNG]`.

Each clip has a row seen from the side (its right) and one in three-quarter view from the front.
"""

import argparse
import io
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from motion import builtin, rotations, skeleton

plt.switch_backend("Agg")  # no screen needed
ROOT = Path(__file__).resolve().parent

INDEX = skeleton.BODY_INDEX
HEAD_TOP = np.array([0.0, 0.0, 0.175])
FOOT_HALF, FOOT_CENTRE = np.array([0.0885, 0.045, 0.0275]), np.array([0.045, 0.0, -0.0225])
RIGHT, LEFT, TRUNK = "#c0392b", "#2166ac", "#333333"
VIEWS = {"side": (-90.0, 4.0), "front": (-25.0, 12.0)}  # camera's azimuth and elevation, degrees


def projector(azimuth, elevation):
    """Function from world points (..., 3) to picture coordinates (..., 2), parallel projection."""
    a, e = np.radians([azimuth, elevation])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    return lambda points: np.asarray(points) @ np.stack([right, up], axis=-1)


def draw(axis, position, rotation, view, shift):
    """One figure (17, 3), (17, 4), drawn `shift` (m) to the right."""
    project = projector(*VIEWS[view])

    def local(name, points):
        return position[INDEX[name]] + rotations.rotate(rotation[INDEX[name]], np.asarray(points))

    def line(points, colour, width=1.2, **options):
        flat = project(points)
        axis.plot(flat[:, 0] + shift, flat[:, 1], color=colour, lw=width, solid_capstyle="round", **options)

    def chain(names, colour):
        line([position[INDEX[name]] for name in names], colour)

    neck = local("torso", [0, 0, 0.2239])
    line([position[0], position[INDEX["torso"]], neck], TRUNK, 1.6)
    for side, colour in (("right", RIGHT), ("left", LEFT)):
        chain(["pelvis", f"{side}_thigh", f"{side}_shin", f"{side}_foot"], colour)
        line([neck, position[INDEX[f"{side}_upper_arm"]]], colour)
        chain([f"{side}_upper_arm", f"{side}_lower_arm", f"{side}_hand"], colour)
        corners = np.array([[x, y, z] for z in (-1, 1) for x, y in ((-1, -1), (-1, 1), (1, 1), (1, -1), (-1, -1))])
        line(local(f"{side}_foot", FOOT_CENTRE + corners * FOOT_HALF), colour, 0.6)
    head = project(local("head", HEAD_TOP))
    axis.add_patch(plt.Circle((head[0] + shift, head[1]), 0.1025, fill=False, color=TRUNK, lw=1.0))
    line([local("head", [0.06, 0, 0.175]), local("head", [0.17, 0, 0.175])], TRUNK, 1.0)  # the nose
    line([local("right_hand", [0.0, 0, 0]), local("right_hand", [1.04, 0, 0])], "#111111", 1.0)
    turn = np.linspace(0, 2 * np.pi, 25)
    rim = local("shield", 0.3 * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=-1))
    flat = project(rim)
    axis.fill(flat[:, 0] + shift, flat[:, 1], color=LEFT, alpha=0.13, lw=0)
    line(rim, LEFT, 0.6)


def sheet(names, count, path):
    """The contact sheet of clips `names`, `count` figures a row, written to `path`."""
    rows = [(name, view) for name in names for view in VIEWS]
    figure, axes = plt.subplots(len(rows), 1, figsize=(1.25 * count, 1.6 * len(rows)), squeeze=False)
    for axis, (name, view) in zip(axes[:, 0], rows):
        clip = builtin.load(name)
        position, rotation = clip.bodies
        spacing = 1.75
        for i, frame in enumerate(np.linspace(0, clip.frames - 1, count).round().astype(int)):
            # a gait would run out of its cells; a lunge or a dodge shows where it goes
            travel = position[frame, 0] * [1, 1, 0] if clip.looping else np.zeros(3)
            draw(axis, position[frame] - travel, rotation[frame], view, i * spacing)
            axis.text(i * spacing, -0.22, f"{frame / clip.fps:.2f}", ha="center", fontsize=6, color="#777777")
        axis.axhline(0.0, color="#bbbbbb", lw=0.5, zorder=0)
        axis.set_xlim(-1.2, (count - 1) * spacing + 1.6)
        axis.set_ylim(-0.28, 2.15)
        axis.set_aspect("equal")
        axis.axis("off")
        axis.set_title(f"{name}, {view}", loc="left", fontsize=7, pad=0)
    figure.tight_layout(pad=0.2, h_pad=0.1)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=80)
    plt.close(figure)
    Image.open(buffer).convert("RGB").quantize(32).save(path, optimize=True)  # a few colours: a third of the size


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", nargs="+", default=list(builtin.NAMES), choices=builtin.NAMES)
    parser.add_argument("--count", type=int, default=10, help="figures a row (default 10)")
    parser.add_argument("--out", default=ROOT / "images" / "builtin_clips.png")
    arguments = parser.parse_args()
    sheet(arguments.clips, arguments.count, arguments.out)


if __name__ == "__main__":
    main()
