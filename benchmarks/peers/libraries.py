"""The lines of the comparison and the variants in which each library is tried."""

import os
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.peers.lines import arguments, count_lines

HERE = Path(__file__).parent
UNLIMITED = 10**12


@dataclass(frozen=True)
class Variant:
    """What a user may choose without changing what is learned. 0 threads of torch: as many as it takes by default."""

    torch_threads: int = 0
    env_runners: int = 0
    threads: int = 1

    def __str__(self):
        where = f"{self.env_runners} env runners x {self.threads}" if self.env_runners else f"{self.threads}"
        return f"torch threads {self.torch_threads or 'default'}, physics threads {where}"


@dataclass(frozen=True)
class Line:
    """One line of the table. source: the file that its user writes."""

    name: str
    title: str
    python: str
    source: Path
    variants: tuple

    @property
    def command(self):
        """Starts its process."""
        return [self.python, "-m", "benchmarks.peers.child", "segue" if self.is_segue else self.name]

    @property
    def is_segue(self):
        """Whether it is started by Segue's own command line."""
        return self.source.suffix == ".txt"

    @property
    def user_lines(self):
        """Lines that a user writes."""
        return count_lines(self.source)

    def arguments(self, folder, overrides):
        """Arguments after the process's own."""
        if not self.is_segue:
            return list(overrides)
        command, *own = arguments(self.source)
        assert shlex.split(command) == ["python", "-m", "orchestrator.train"]
        # the benchmark's own scale may be changed, what makes a line may not; besides where it writes and that it ends
        # only when it is asked to, the rest is the user's
        own.sort(key=lambda argument: not argument.startswith("scale="))
        ends = [f"budget.samples={UNLIMITED}", f"out={folder}/run", f"tracking.uri=sqlite:///{folder}/mlflow.db"]
        return [own[0], *overrides, *own[1:], *ends]


def build_lines(python, scale="demo"):
    """All `Line`s by name; python: interpreter of the other libraries; scale: Segue's, for its title."""
    cores = os.cpu_count()
    # collecting and learning take turns in one process: physics may have every core
    turns = tuple(Variant(torch, 0, cores) for torch in (0, 1))
    rllib = (*turns, Variant(0, cores, 1), Variant(1, cores, 1))
    segue = (Variant(1),)  # its own command line decides over threads
    lines = (
        Line("segue", f"Segue (scale={scale})", sys.executable, HERE / "segue.txt", segue),
        Line("segue_plain", "Segue, plain PPO", sys.executable, HERE / "segue_plain.txt", segue),
        Line("sb3", "Stable-Baselines3", python, HERE / "sb3.py", turns),
        Line("rsl", "rsl-rl", python, HERE / "rsl_rl_ppo.py", turns),
        Line("rllib", "RLlib", python, HERE / "rllib.py", rllib),
    )
    return {line.name: line for line in lines}
