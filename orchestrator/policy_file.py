"""Make a policy file of a run: its policy for use elsewhere, a fifth of a checkpoint, which cannot be continued.

usage: python -m orchestrator.policy_file RUN FILE.pt

  python -m orchestrator.policy_file runs/builtin/ours-seed0 configs/policies/builtin.pt

FILE.pt is what `python -m orchestrator.evaluate FILE.pt` takes: the averaged policy of the run's newest checkpoint,
the critics that a run goes on from that begins with it (start.checkpoint), where its curriculum stood, a hash of its
clips and its configuration, but no paths of this machine.
"""

import sys
from pathlib import Path

from learner.checkpoint import encode
from learner.storage import replace_file
from motion.errors import InputError
from orchestrator import folder as run_folder
from orchestrator import saved
from orchestrator.console import run_command
from orchestrator.settings import load


def main(arguments):
    """Command line; see the module's docstring."""
    if len(arguments) != 2 or not arguments[1].endswith(".pt"):
        raise InputError("give a run's folder and FILE.pt, e.g. runs/builtin/ours-seed0 mine.pt")
    run, out = map(Path, arguments)
    path = run_folder.config_path(run)
    if not path.exists():
        raise InputError(f"{run}: no config.yaml there; give the folder of a run")
    config = load(path)
    content, source = saved.load_latest(run, config)
    if content is None:
        raise InputError(f"{run}: holds no checkpoint; train it first (python -m orchestrator.train out={run})")
    data = encode(saved.policy_content(content, config))
    replace_file(out, data)
    print(f"written: {out}, {len(data) / 1e6:.1f} MB, of {source}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__, sys.argv[1:]))
