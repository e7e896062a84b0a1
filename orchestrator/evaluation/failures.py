"""The list of failed tasks, failures.csv: one line per task, with what is needed to replay it."""

import csv
import os
from pathlib import Path

from learner.storage import cannot_write, sync_folder
from motion.skeleton import BODY_NAMES
from workers.types import FELL, REACHED, TIMED_OUT

HEADER = (
    "task", "source", "moment", "target", "rotation", "failed", "end", "body", "steps",
    "root_position", "key_bodies", "joint_rotation", "deterministic_end", "deterministic_body", "deterministic_steps",
)  # fmt: skip


def failures_of(noise, calm):
    """Rows (plain lists) of the tasks that failed in either pass: `Outcomes` of the same tasks, with noise and without.

    A row is: number, source, moment, target, rotation; end, body that fell, steps, d_rp, d_kp, d_q of the last frame
    with noise; end, body and steps without.
    """
    rows = []
    for i in ((noise.end != REACHED) | (calm.end != REACHED)).nonzero()[0]:
        source, moment, target, rotation = noise.task[i].tolist()
        rows.append([
            int(noise.environment[i]), int(source), moment, int(target), rotation,
            int(noise.end[i]), int(noise.fell_on[i]), int(noise.steps[i]), *noise.deviations[i, [0, 3, 4]].tolist(),
            int(calm.end[i]), int(calm.fell_on[i]), int(calm.steps[i]),
        ])  # fmt: skip
    return rows


def write(path, shards, states):
    """Write failures.csv at once or not at all; returns the number of lines.

    shards: iterable of lists of rows, taken one after the other, so that not all of them are in memory. states: names.
    """
    path, count = Path(path), 0
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(HEADER)
            for rows in shards:
                writer.writerows(_line(row, states) for row in rows)
                count += len(rows)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise cannot_write(path, error) from error
    return count


def _line(row, states):
    number, source, moment, target, rotation, end, body, steps, *deviations, calm_end, calm_body, calm_steps = row
    noise, calm = end != REACHED, calm_end != REACHED
    return [
        number, states[source], moment, states[target], rotation,
        "both" if noise and calm else "noise" if noise else "deterministic",
        *ended(end, body), steps, *(f"{value:.6g}" for value in deviations), *ended(calm_end, calm_body), calm_steps,
    ]  # fmt: skip


def ended(end, body):
    """(how an episode ended, the body that it fell on or nothing), in words."""
    if end == FELL and body < 0:
        return "exploded", ""
    words = {REACHED: "reached", FELL: "fell", TIMED_OUT: "timed out"}
    return words[end], BODY_NAMES[body] if end == FELL else ""
