"""The configuration of one run: every key, its default and its meaning. A run is a deterministic function of it.

Defaults are the paper's (configs/scale/paper.yaml adds its sizes). `orchestrator.settings` reads files and command
lines into this and checks the values.
"""

from dataclasses import dataclass, field

from learner.config import LearnerConfig
from motion.state_machine import MotionsConfig
from workers.config import EnvConfig


@dataclass
class BudgetConfig:
    """How long a run trains: whichever of the two ends first; at least one must be given."""

    samples: int | None = None
    """Environment steps in all."""
    iterations: int | None = None
    """Updates of the learner; each uses num_envs * horizon samples."""


@dataclass
class StartConfig:
    """What a run begins with, other than fresh networks and the first thresholds."""

    checkpoint: str | None = None
    """A checkpoint, or the folder of a run for its newest one, whose learner this run begins with: networks, optimizers
    and normalizers; or a policy's file, or the name of one that comes with Segue (nine), with its critics (an
    older version's has none) and fresh optimizers: see `ppo.policy_after`. Simulations and counters (schedules, too)
    begin anew, and clips may be others. Read once: the run keeps a copy as its checkpoint 0. None: fresh networks."""
    tightenings: int | None = None
    """Tightenings of the thresholds to begin with; none: as many as the checkpoint had."""


@dataclass
class CurriculumConfig:
    """Shrinking thresholds (Eq. 16)."""

    start: list[float] = field(default_factory=lambda: [0.3, 3.0, 1.0])
    """First thresholds of d^rp (m), d^kp (m) and d^q (rad)."""
    floor: list[float] = field(default_factory=lambda: [0.01, 0.09, 0.15])
    """Last thresholds: the final accuracy."""
    factor: float = 0.9
    """Each tightening multiplies the thresholds by this, down to the floor."""
    achievement: float = 0.88
    """Tighten when the achievement rate over the window exceeds this."""
    window: int = 100
    """Length of the sliding window; it restarts after every tightening and must be full."""
    count_retained: bool = True
    """Count episodes of tasks that were kept after a failure. False: only freshly drawn ones, whose rate is that over
    all tasks; kept tasks are the hard ones and bias it downwards."""
    window_unit: str = "iterations"
    """Unit of the window: `iterations` or `episodes`."""
    scope: str = "run"
    """What shares one sequence of thresholds, with a window of its own: `run`, the paper: all tasks; `source`: those
    that start from one clip; `group`: those from one clip to another. A run's thresholds are then its loosest."""


@dataclass
class CheckpointConfig:
    """Checkpoints of a run."""

    every: int = 10
    """Iterations between checkpoints."""
    keep: int = 3
    """How many are kept."""
    storage: str | None = None
    """Where they go: a URL such as file:///mnt/x or s3://bucket/x, below which each run gets a folder of its own; none:
    the run's folder."""


@dataclass
class FaultsConfig:
    """Lost processes and machines. No value changes a number of the run."""

    restarts: int = 5
    """Faults in a row, without a new iteration in between, that a run survives."""
    hang_timeout: float = 900.0
    """Seconds without an answer after which an actor is taken for hung and replaced."""


@dataclass
class EvaluationConfig:
    """The grid of tasks and the noise of section 6."""

    moment_spacing: float = 0.03
    """Seconds between source moments in a cancel range."""
    rotation_spacing: float = 0.03490658503988659
    """Radians between rotations (pi / 90)."""
    max_tasks: int = 0
    """Evaluate at most this many tasks, spread evenly over the grid; 0: all."""
    num_envs: int = 256
    """Simulations at a time in one process."""
    log_sigma: float = -3.7
    """Log of the actions' standard deviation in radians, whatever `action.scale` is."""
    robustness_bracket: list[float] = field(default_factory=lambda: [-5.0, -2.0])
    """Log of the smallest and the largest noise (in radians) that MS, the largest one at which every task is reached,
    may be."""
    robustness_resolution: float = 0.1
    """To how much MS is found, in log sigma."""
    num_workers: int = 0
    """Processes of `python -m orchestrator.evaluate` on Ray, one CPU each; 0: one per free CPU."""


@dataclass
class TrackingConfig:
    """MLflow. The address is MLFLOW_TRACKING_URI, else `uri`, else SQLite in mlflow.db of the working directory."""

    enabled: bool = True
    """Log runs to MLflow."""
    uri: str | None = None
    """Tracking address; MLFLOW_TRACKING_URI goes before it."""
    system_metrics: bool = True
    """Log the load of the machine that the run's loop runs on: processors, memory, disk, network, GPUs."""
    register_model: bool = True
    """Register the policy of a finished run as a model of MLflow."""


@dataclass
class ReportConfig:
    """report.html at the end of a sweep. No value changes a number of a run."""

    enabled: bool = True
    """Make it at the end of a sweep."""
    strips: int = 3
    """Film strips of transitions, each beside interpolation of the same task; 0: none."""
    videos: int = 4
    """Looping videos of transitions, half of them of the worst; 0: none."""
    tasks: int = 100
    """Tasks of the evaluation's grid on which the policy is compared with kinematic transitions; 0: no comparison."""
    figures: str | None = None
    """Folder to which curves, strips and videos are written as files, too."""


@dataclass
class Config(EnvConfig, LearnerConfig):
    """One run. Keys of the environment (workers.config) and of the learner (learner.config) stand at the top level."""

    motions: MotionsConfig = field(default_factory=lambda: MotionsConfig(name="builtin"))
    """Clips and state machine; `motions=NAME` chooses a file of configs/motions/ (or a path)."""
    scale: str = "laptop"
    """Which file of configs/scale/ was applied before all other overrides."""
    row: str = "ours"
    """Row of the table that this run belongs to."""
    seed: int = 0
    """All random numbers of the run are functions of this."""
    out: str | None = None
    """Folder of the sweep or run; default runs/<sweep>."""
    runtime: str = "ray"
    """`ray`: actors. `local`: the same numbers in one process, for debugging."""
    device: str = "auto"
    """Where the learner computes: `auto`, `cpu` or `cuda`."""
    num_envs: int = 4096
    """Simulations in all, over all workers."""
    num_workers: int = 1
    """Rollout workers; each steps an equal share of the simulations."""
    worker_threads: int = 1
    """Threads (and CPUs) of one worker."""
    spare_threads: int = 0
    """runtime=ray: more threads of one worker, which ask Ray for no CPU. The worker steps back for everything else on
    its machine, and so has the learner's CPU while that waits for the next chunk."""
    learner_threads: int = 1
    """Threads (and CPUs) of the learner; for small networks one is the fastest."""
    horizon: int = 16
    """Steps per simulation and chunk."""
    pipeline_depth: int = 1
    """d: chunk k is collected with policy k - d. 0: learner and workers take turns; 1: they overlap."""
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    start: StartConfig = field(default_factory=StartConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    faults: FaultsConfig = field(default_factory=FaultsConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    report: ReportConfig = field(default_factory=ReportConfig)

    @property
    def samples_per_iteration(self):
        """Environment steps per iteration, num_envs * horizon."""
        return self.num_envs * self.horizon

    @property
    def total_iterations(self):
        """Iterations that the budget allows."""
        limits = [self.budget.iterations] if self.budget.iterations is not None else []
        if self.budget.samples is not None:
            limits.append(-(-self.budget.samples // self.samples_per_iteration))
        return min(limits)
