"""`motion` starts at once: it needs neither physics nor learning packages."""

import json
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).parents[2]

PROGRAM = """
import json, sys, time
start = time.perf_counter()
import motion, motion.clip, motion.formats, motion.state_machine
print(json.dumps([time.perf_counter() - start, sorted({name.partition(".")[0] for name in sys.modules})]))
"""


def import_once():
    """Seconds that the import took in a fresh interpreter, and the top-level packages that it brought in."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=PROJECT, capture_output=True, text=True, check=True)
    seconds, packages = json.loads(done.stdout)
    return seconds, set(packages)


def test_importing_motion_brings_in_no_heavy_package_and_takes_less_than_a_second():
    runs = [import_once() for _ in range(3)]
    packages = runs[0][1]
    assert "numpy" in packages
    assert not packages & {"torch", "ray", "mujoco", "omegaconf", "scipy"}
    assert min(seconds for seconds, _ in runs) < 1.0
